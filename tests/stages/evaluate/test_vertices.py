"""Garments against true meshes that are off by a known distance."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from gw_cli.app import app
from stages.evaluate.vertices import posing_of
from stages.shared.artifacts import Workspace
from stages.shared.layers import LAYERS
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.trained_subject import TrainedSubject
from tests.shared.outfit.wardrobe import FRAMES, motion, outfit, tube_mesh

APART = 0.01  # m, between the true skirt of the test take and what the bones make of it


def outfit_of(subject: Path) -> Outfit:
    workspace = Workspace(subject)
    return TrainedSubject.open(workspace.root).outfit()


def write_truth(path: Path, dressed: Outfit, frames: list[int], shift: float, reverse: bool = False) -> Path:
    """The skirt as the bones move it, `shift` m to the side in all frames but the first."""
    bones = posing_of(dressed).bones
    points = np.stack([bones(motion(), frame)["lower"] for frame in frames])
    points[1:, :, 0] += np.float32(shift)
    faces = tube_mesh(dressed.layers[dressed.names.index("lower")])["faces"]
    path.parent.mkdir(parents=True)
    np.savez(path, frames=frames, lower_v=points, lower_f=faces[:, ::-1] if reverse else faces)
    return path


@pytest.fixture(scope="module")
def truths(dressed_subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The true skirt: where the bones have it in the training take, beside it in the test take."""
    folder = tmp_path_factory.mktemp("truths")
    dressed = outfit_of(dressed_subject)
    write_truth(folder / "moves/gt/meshes.npz", dressed, [0, 2], 0.0)
    write_truth(folder / "other/gt/meshes.npz", dressed, [0, 1, 3], APART)
    return folder


def evaluated(subject: Path, out: Path, *words: str) -> dict:
    command = ["evaluate", str(subject), "-o", str(out), "--cameras", "1", "--frame-step", "2", "--json"]
    done = CliRunner().invoke(app, [*command, "--methods", "trained", *words])
    assert done.exit_code == 0, (done.stderr, done.stdout[-2000:])
    return json.loads(done.stdout.splitlines()[-1])["result"]["vertex_error"]


def test_a_skirt_that_hangs_beside_itself(dressed_subject: Path, truths: Path, tmp_path: Path) -> None:
    found = evaluated(dressed_subject, tmp_path / "out", "--true-meshes", str(truths))
    for pose in (found["novel_pose"]["bones_without_first"], found["novel_pose"]["trained_without_first"]):
        skirt = pose["lower"]
        assert set(pose) == {"lower"} and skirt["frames"] == 2  # of five scored frames the file holds three
        assert skirt["points"] == skirt["points_of_the_cloth"] > 100
    bones = found["novel_pose"]["bones_without_first"]["lower"]
    assert bones["material"] == pytest.approx({"mean": APART, "median": APART, "p95": APART}, abs=2e-6)
    assert 0.0005 < bones["surface"]["median"] < APART  # most of the way is along the surface
    assert found["novel_pose"]["bones"]["lower"]["material"]["mean"] == pytest.approx(APART * 2 / 3, abs=2e-6)
    view = found["novel_view"]["bones"]["lower"]
    assert view["frames"] == 2 and view["material"]["p95"] < 2e-6 and view["surface"]["p95"] < 2e-6
    stored = json.loads((tmp_path / "out/evaluation.json").read_text())
    assert stored["vertex_error"] == found
    rows = json.loads((tmp_path / "out/vertices.json").read_text())
    own = [row for row in rows if row["method"] == "bones" and row["split"] == "novel_pose"]
    assert [(row["frame"], row["first"]) for row in own] == [(0, True), (1, False), (3, False)]
    assert [round(row["material"]["mean"], 5) for row in own] == [0, APART, APART]


def test_what_was_learned_is_what_is_measured(dressed_subject: Path) -> None:
    """Offsets of the model move the centres; the bones alone know nothing of them."""
    dressed = outfit_of(dressed_subject)
    skirt = dressed.layers[dressed.names.index("lower")]
    posing, poses = posing_of(dressed), motion()
    gaussians = dressed.posed(poses, 1)["lower"]
    np.testing.assert_array_equal(posing.centres(poses, 1)["lower"], gaussians.means.numpy())
    moved = replace(gaussians, means=gaussians.means + torch.tensor([0.0, 0.0, 0.5]))
    other = posing_of(dressed, lambda *_: {"lower": moved, "upper": moved})
    apart = other.centres(poses, 1)["lower"] - posing.centres(poses, 1)["lower"]
    np.testing.assert_allclose(apart, [[0, 0, 0.5]] * len(skirt.maps), atol=1e-6)
    np.testing.assert_array_equal(other.bones(poses, 1)["lower"], posing.bones(poses, 1)["lower"])


def test_garments_inside_one_layer_of_a_baseline() -> None:
    """Texels of a layer that holds the whole person are told apart by the layer they are on."""
    plain = outfit("upper")
    maps = plain.layers[0].maps
    ids = torch.where(maps.positions[:, 1] > 0.08, LAYERS.index("upper"), LAYERS.index("lower"))
    ids[:3] = LAYERS.index("body")
    whole = replace(plain.layers[0], name="whole", layer_ids=ids)
    posing = posing_of(replace(plain, layers=(whole,)))
    points = posing.bones(motion(), 0)
    counts = {name: int((ids == LAYERS.index(name)).sum()) for name in ("upper", "lower")}
    assert {name: len(values) for name, values in points.items()} == counts
    np.testing.assert_array_equal(points["upper"], posing_of(plain).bones(motion(), 0)["upper"][ids == 2])
    for name, triangles in posing.triangles.items():
        assert len(triangles) > 50 and triangles.max() < counts[name]
        edges = points[name][triangles] - points[name][np.roll(triangles, 1, axis=1)]
        assert np.linalg.norm(edges, axis=2).max() < 0.12  # of texels that are neighbours


def test_cloth_is_not_followed_without_its_template(
    dressed_subject: Path, truths: Path, tmp_path: Path
) -> None:
    """Without the training take, or with another cloth in it, surfaces alone can be compared."""
    other = truths / "other/gt/meshes.npz"
    words = ["--split", "novel-pose", "--true-meshes", str(other)]
    alone = evaluated(dressed_subject, tmp_path / "a", *words)["novel_pose"]["trained"]["lower"]
    assert alone["material"]["mean"] is None and alone["points_of_the_cloth"] is None
    assert alone["surface"]["mean"] > 0
    dressed = outfit_of(dressed_subject)
    wrong = write_truth(tmp_path / "moves/meshes.npz", dressed, list(range(FRAMES)), 0.0, reverse=True)
    changed = evaluated(dressed_subject, tmp_path / "b", *words, "--true-meshes", str(wrong))
    assert changed["novel_pose"]["trained"]["lower"] == alone


def test_what_is_refused(dressed_subject: Path, truths: Path, tmp_path: Path) -> None:
    subject, out = str(dressed_subject), ["-o", str(tmp_path / "out")]
    training = str(truths / "moves/gt/meshes.npz")
    for words, code in (
        (["--images", "a", "--truth", "b", "--true-meshes", training], 2),
        ([subject, "--methods", "baseline", "--true-meshes", training], 2),
        ([subject, "--true-meshes", str(tmp_path / "none.npz")], 66),
        ([subject, "--split", "novel-pose", "--cameras", "1", "--true-meshes", training], 66),
        ([subject, "--dry-run", "--true-meshes", str(tmp_path / "none.npz")], 66),
    ):
        done = CliRunner().invoke(app, ["evaluate", *words, *out])
        assert done.exit_code == code, (words, done.output)
    plan = CliRunner().invoke(
        app, ["evaluate", subject, *out, "--true-meshes", str(truths), "--dry-run", "--json"]
    )
    assert "vertices.json" in plan.stdout and not (tmp_path / "out").exists()
