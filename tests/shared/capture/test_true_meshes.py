"""True meshes as files: what is read, what is refused, and of which take a file is."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stages.shared.capture.true_meshes import read_true_meshes, true_meshes_of
from stages.shared.errors import BadData, MissingInput, UsageProblem

CAPTURE: Any = SimpleNamespace(takes=(SimpleNamespace(name="walk"), SimpleNamespace(name="dance")))


def arrays() -> dict[str, np.ndarray]:
    vertices = np.arange(2 * 4 * 3, dtype=np.float64).reshape(2, 4, 3)
    return {
        "frames": np.array([3, 8]),
        "lower_v": vertices,
        "lower_f": np.array([[0, 1, 2], [1, 2, 3]]),
        "hair_v": vertices[0],
    }


def write(path: Path, **changed: np.ndarray | None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{name: a for name, a in {**arrays(), **changed}.items() if a is not None})
    return path


def test_frames_and_garments(tmp_path: Path) -> None:
    found = read_true_meshes(write(tmp_path / "m.npz"))
    assert set(found.layers) == {"lower"} and dict(found.rows) == {3: 0, 8: 1}
    np.testing.assert_array_equal(found.at("lower", 8), arrays()["lower_v"][1])
    other = read_true_meshes(write(tmp_path / "o.npz", lower_f=np.array([[0, 1, 2], [1, 3, 2]])))
    assert found.layers["lower"].same_cloth(found.layers["lower"])
    assert not found.layers["lower"].same_cloth(other.layers["lower"])


@pytest.mark.parametrize(
    "changed",
    [
        {"frames": np.array([3, 3])},
        {"frames": np.array([3, -1])},
        {"frames": np.array([3.0, 8.0])},
        {"frames": np.array([3, 8, 9])},
        {"frames": None},
        {"lower_v": None},
        {"lower_f": None},
        {"lower_f": np.array([[0, 1, 4]])},
        {"lower_f": np.array([[0, 1, -1]])},
        {"lower_f": np.zeros((0, 3), int)},
        {"lower_f": np.array([[0.0, 1.0, 2.0]])},
        {"lower_v": np.zeros((2, 4))},
        {"lower_v": np.full((2, 4, 3), np.nan)},
        {"lower_v": np.array([[["a"] * 3] * 4] * 2)},
    ],
)
def test_files_that_do_not_fit_together(changed: dict[str, np.ndarray | None], tmp_path: Path) -> None:
    with pytest.raises(BadData) as refused:
        read_true_meshes(write(tmp_path / "m.npz", **changed))
    assert "m.npz" in refused.value.where


def test_of_which_take_a_file_is(tmp_path: Path) -> None:
    alone = write(tmp_path / "m.npz", frames=np.array([1, 2]))
    inside = write(tmp_path / "walk/gt/meshes.npz")
    assert 1 in true_meshes_of([f"dance={alone}"], CAPTURE)["dance"].rows
    assert set(true_meshes_of([str(inside)], CAPTURE)) == {"walk"}
    assert set(true_meshes_of([str(tmp_path), f"dance={alone}"], CAPTURE)) == {"walk", "dance"}
    write(tmp_path / "native/takes/dance/gt/meshes.npz")
    assert set(true_meshes_of([str(tmp_path / "native")], CAPTURE)) == {"dance"}
    assert true_meshes_of([], CAPTURE) == {}
    with pytest.raises(UsageProblem, match="not clear of which take") as unclear:
        true_meshes_of([str(alone)], CAPTURE)
    assert "TAKE=" in unclear.value.fix and "dance" in unclear.value.fix
    for missing in ("none.npz", "dance=none.npz", str(tmp_path / "walk/gt")):
        with pytest.raises(MissingInput):
            true_meshes_of([missing], CAPTURE)
