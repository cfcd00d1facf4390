"""Body model files: what loads, what is refused, and what the embedded one is."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from stages.shared.body import JOINTS, PARENTS, BodyModel, embedded_body, load_body, shaped_joints
from stages.shared.body.load import EMBEDDED_FILE
from stages.shared.errors import BadData, MissingInput
from tests.shared.conftest import VERTICES, smplx_arrays


def write(path: Path, **changes: np.ndarray | None) -> Path:
    """A valid file with some arrays replaced, or left out where None."""
    arrays = {**smplx_arrays(), **changes}
    np.savez(path, **{name: values for name, values in arrays.items() if values is not None})
    return path


@pytest.mark.parametrize(
    ("columns", "expression_first"), [(10, None), (16, None), (20, 10), (300, None), (400, 300)]
)
def test_shape_and_expression_columns(tmp_path: Path, columns: int, expression_first: int | None) -> None:
    directions = smplx_arrays(columns)["shapedirs"]
    body = load_body(write(tmp_path / "body.npz", shapedirs=directions))
    np.testing.assert_allclose(body.shape_directions, directions[:, :, :10], rtol=1e-6)
    if expression_first is None:
        assert body.expression_directions is None
    else:
        wanted = directions[:, :, expression_first : expression_first + 10]
        np.testing.assert_allclose(body.expression_directions, wanted, rtol=1e-6)


def test_full_file_with_an_object_array_that_is_not_needed(smplx_file: Path) -> None:
    body = load_body(smplx_file)
    arrays = smplx_arrays(400)
    assert body.pose_directions.shape == (486, VERTICES * 3)
    np.testing.assert_allclose(body.pose_directions[7].reshape(-1, 3), arrays["posedirs"][:, :, 7], rtol=1e-5)
    np.testing.assert_allclose(body.hand_components_left, arrays["hands_componentsl"], rtol=1e-5)
    np.testing.assert_allclose(body.hand_mean_right, arrays["hands_meanr"], rtol=1e-5)
    assert body.faces.dtype == np.int32


def test_arrays_go_round_through_safetensors(smplx_file: Path, tmp_path: Path) -> None:
    body = load_body(smplx_file)
    save_file(body.to_arrays(), tmp_path / "body.safetensors")
    again = load_body(tmp_path / "body.safetensors")
    assert again.digest == body.digest
    moved = {**body.to_arrays(), "template_vertices": body.template_vertices + 1e-6}
    assert BodyModel.from_arrays(moved).digest != body.digest


def test_a_pickle_is_refused_and_not_opened(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (tmp_path / "opened",))  # type: ignore[return-value]

    path = tmp_path / "SMPLX_NEUTRAL.npz"
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(BadData, match="pickle"):
        load_body(path)
    assert not (tmp_path / "opened").exists()


def bad_weights() -> np.ndarray:
    return smplx_arrays()["weights"] * np.r_[0.2, np.ones(VERTICES - 1)][:, None]


def with_value(name: str, value: float) -> np.ndarray:
    values = smplx_arrays()[name].astype(np.float64)
    values.reshape(-1)[5] = value
    return values


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"v_template": None}, "lacks the array 'v_template'"),
        ({"J_regressor": np.array([{}], dtype=object)}, "Python objects"),
        ({"v_template": with_value("v_template", np.nan)}, "NaN"),
        ({"weights": with_value("weights", np.inf)}, "NaN or infinity"),
        ({"f": np.array([[0, 1, VERTICES]])}, "outside"),
        ({"f": np.zeros((0, 3), int)}, "faces"),
        ({"shapedirs": np.zeros((VERTICES, 3, 6))}, "at least 10"),
        ({"shapedirs": np.zeros((VERTICES - 1, 3, 10))}, "shape_directions has shape"),
        ({"kintree_table": np.zeros((2, 24), int)}, "24 joints \\(SMPL\\)"),
        ({"kintree_table": np.zeros((2, 55), int)}, "hangs on"),
        ({"J_regressor": np.zeros((55, VERTICES))}, "sum to 1"),
        ({"posedirs": np.zeros((VERTICES, 3, 207))}, "pose_directions"),
        ({"hands_meanl": np.zeros(44)}, "hand_mean_left has shape"),
        ({"hands_componentsr": np.zeros((45, 44))}, "hand_components_right has shape"),
        *(
            ({name: np.array(1.0)}, "shape|joints|faces")
            for name in (
                "v_template",
                "f",
                "shapedirs",
                "J_regressor",
                "weights",
                "kintree_table",
                "posedirs",
                "hands_meanl",
                "hands_componentsl",
            )
        ),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, changes: dict[str, np.ndarray | None], message: str) -> None:
    with pytest.raises(BadData, match=message):
        load_body(write(tmp_path / "body.npz", **changes))


def test_weights_rounded_in_the_file_are_normalised(tmp_path: Path) -> None:
    path = write(tmp_path / "body.npz", weights=smplx_arrays()["weights"].astype(np.float16))
    np.testing.assert_allclose(load_body(path).skin_weights.sum(1), 1, atol=1e-6)


def test_missing_truncated_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(MissingInput):
        load_body(tmp_path / "nothing.npz")
    whole = write(tmp_path / "body.npz").read_bytes()
    for name, data in (("half.npz", whole[: len(whole) // 2]), ("text.npz", b"hello"), ("empty.npz", b"")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(BadData, match="cannot be read"):
            load_body(tmp_path / name)
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 0xFF
    (tmp_path / "flipped.npz").write_bytes(bytes(flipped))
    with pytest.raises(BadData):
        load_body(tmp_path / "flipped.npz")


def test_embedded_body_is_small_closed_and_in_the_convention() -> None:
    body = embedded_body()
    assert EMBEDDED_FILE.stat().st_size <= 4 << 20
    ends = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]]).astype(
        np.int64
    )
    directed = ends[:, 0] * len(body.template_vertices) + ends[:, 1]
    reverse = ends[:, 1] * len(body.template_vertices) + ends[:, 0]
    assert len(np.unique(directed)) == len(directed)  # every edge once each way: closed, oriented, manifold
    assert np.array_equal(np.sort(directed), np.sort(reverse))
    assert len(body.template_vertices) - len(ends) // 2 + len(body.faces) == 2  # one piece without handles
    corners = body.template_vertices[body.faces].astype(np.float64)
    volume = np.einsum("fk,fk->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert 0.04 < volume < 0.12  # outward normals, and a person's volume in cubic metres
    height = np.ptp(body.template_vertices[:, 1])
    assert 1.6 < height < 1.95
    np.testing.assert_allclose(body.joint_template[0], 0, atol=1e-5)
    np.testing.assert_allclose(body.skin_weights.sum(1), 1, atol=1e-5)


def test_embedded_body_is_symmetric_enough_and_stands_as_a_t() -> None:
    joints = embedded_body().joint_template
    for left, name in enumerate(JOINTS):
        if name.startswith("left_"):
            right = JOINTS.index("right_" + name.removeprefix("left_"))
            np.testing.assert_allclose(joints[left] * [-1, 1, 1], joints[right], atol=3e-3)
            assert joints[left, 0] > 0.02
    for joint in (18, 20):  # elbow and wrist level with the shoulder
        np.testing.assert_allclose(joints[joint, 1:], joints[16, 1:], atol=2e-3)
    feet = joints[10] - joints[7]
    assert feet[2] > 0.1  # facing +z


def test_embedded_joints_stay_inside_the_body_for_all_shapes() -> None:
    body = embedded_body()
    for betas in (np.full(10, 2.0), np.full(10, -2.0), np.r_[4.0, np.zeros(9)]):
        joints = shaped_joints(body, torch.from_numpy(betas)).numpy()
        assert np.isfinite(joints).all()
        lengths = [np.linalg.norm(joints[j] - joints[p]) for j, p in enumerate(PARENTS) if p >= 0]
        assert min(lengths) > 0.003 and max(lengths) < 0.9


def test_embedded_and_independent_file_agree_in_convention(shared_folder: Path) -> None:
    path = shared_folder / "body" / "anny_smplx_format.npz"
    if not path.is_file():
        pytest.skip("no body model beside the checkout (../shared/body)")
    theirs, ours = load_body(path).joint_template, embedded_body().joint_template
    assert np.linalg.norm(theirs - ours, axis=1).max() < 0.05
