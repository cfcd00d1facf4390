"""The stage on a small capture: what it writes, what it refuses, what it takes up again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.pipeline import REGISTER_TEMPLATE
from stages.register_template.config import PRESETS
from stages.register_template.fitting.bones import State, bones_of, vertices_of
from stages.register_template.fitting.fit_scan import fit_scan
from stages.register_template.stage import plan, run
from stages.shared.artifacts import Workspace
from stages.shared.body import BodyModel, Poses, embedded_body, load_body
from stages.shared.body.posed import posed_body
from stages.shared.capture.subject import open_subject_capture
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.meshes.load import load_mesh, write_ply
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene
from stages.shared.poses import load_poses
from stages.shared.report import SILENT

from .scenes import a_pose, write_capture

TINY = PRESETS["tiny"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("capture") / "person")


def test_hull_of_the_most_open_frame(capture: Path, tmp_path: Path) -> None:
    subject = tmp_path / "subject"
    result = run(capture, subject, TINY)
    assert result.summary["template_source"] == "hull"
    assert result.summary["frame"] == 1 and result.summary["take"] == "walk"
    assert min(result.summary["share_inside"].values()) > 0.97
    assert sorted(result.summary["share_inside"]) == [f"cam{index}" for index in range(6)]

    template = result.artifact.arrays("template")
    body = embedded_body()
    posed = posed_body(body, a_pose()[1])
    away = RayScene(posed, body.faces).distance(template["vertices"])
    # Six views leave bulges between the limbs; most of the surface is right.
    assert np.median(away) < 0.01 and np.percentile(away, 90) < 0.08
    left = template["vertices"][:, 0] > 0.1
    assert (template["colors"][left, 0] > template["colors"][left, 2]).mean() > 0.95

    assert load_poses(subject / "smpl_params.npz").to_npz_bytes() == a_pose().to_npz_bytes()
    assert BodyModel.from_arrays(result.artifact.arrays("body")).digest == body.digest
    assert result.artifact.file("overlay.png").stat().st_size > 1000
    settings = json.loads((subject / "subject.json").read_text())
    assert (subject / settings["capture"]).resolve() == capture.resolve()


def test_again_is_the_same_artifact_and_options_make_another(capture: Path, tmp_path: Path) -> None:
    first = run(capture, tmp_path / "s", replace(TINY, template="body"))
    assert run(capture, tmp_path / "s", replace(TINY, template="body")).artifact.key == first.artifact.key
    forced = run(capture, tmp_path / "s", replace(TINY, template="body"), force=True)
    assert forced.artifact.digest == first.artifact.digest
    other = run(capture, tmp_path / "s", replace(TINY, template="body", frame=0))
    assert other.artifact.key != first.artifact.key and other.summary["frame"] == 0
    np.testing.assert_allclose(
        other.artifact.arrays("template")["vertices"], posed_body(embedded_body(), a_pose()[0]), atol=1e-5
    )


def test_poses_of_somebody_else_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    poses = a_pose()
    elsewhere = Poses(poses.rotations, poses.translation + [0.5, 0.0, 0.0], poses.betas, poses.expression)
    capture = write_capture(tmp_path / "wrong", elsewhere)
    with pytest.raises(BadData, match="in the masks") as caught:
        run(capture, tmp_path / "s", TINY)
    assert "as is" in caught.value.where  # says which conventions were tried
    assert Workspace(tmp_path / "s").current(REGISTER_TEMPLATE) is None
    assert not list((tmp_path / "s").glob("**/template.safetensors"))
    assert not (tmp_path / "s" / "smpl_params.npz").exists()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"template": "nerf"}, UsageProblem, "no template"),
        ({"frame": 7}, UsageProblem, "no frame 7"),
        ({"take": "run"}, UsageProblem, "no take"),
        ({"template": "scan"}, MissingInput, "no scan"),
    ],
)
def test_options_that_cannot_be_meant(
    capture: Path, tmp_path: Path, changes: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        run(capture, tmp_path / "s", replace(TINY, **changes))


def test_plan_writes_nothing(capture: Path, tmp_path: Path) -> None:
    made = plan(capture, tmp_path / "s", TINY)
    assert made.config["template"] == "hull" and made.config["frame"] == 1
    assert any("masks" in path for path in made.inputs) and made.seconds
    assert not (tmp_path / "s").exists()


def test_a_mesh_with_given_parameters(tmp_path: Path) -> None:
    body = embedded_body()
    posed = posed_body(body, a_pose()[1])
    write_ply(tmp_path / "scan.ply", Mesh(posed.astype(np.float32), body.faces))
    a_pose().save(tmp_path / "params.npz")
    config = replace(TINY, frame=1)
    result = run(tmp_path / "scan.ply", tmp_path / "s", config, params=tmp_path / "params.npz")
    assert result.summary["template_source"] == "mesh" and result.summary["frame"] == 1
    assert result.summary["template_to_body_m"] < 1e-4
    with pytest.raises(UsageProblem, match="no frame 9"):
        run(tmp_path / "scan.ply", tmp_path / "t", replace(TINY, frame=9), params=tmp_path / "params.npz")
    far = replace(a_pose(), translation=a_pose().translation + 1)
    far.save(tmp_path / "far.npz")
    with pytest.raises(BadData, match="farther"):
        run(tmp_path / "scan.ply", tmp_path / "u", config, params=tmp_path / "far.npz")


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match="no such capture"):
        run(tmp_path / "nothing", tmp_path / "s", TINY)


def test_subject_a_fits_its_masks(subject_a: Path, shared_folder: Path, tmp_path: Path) -> None:
    model = shared_folder / "body" / "anny_smplx_format.npz"
    result = run(subject_a, tmp_path / "s", TINY, body_model=model)
    assert result.summary["template_source"] == "scan" and result.summary["frame"] == 0
    assert result.summary["mean_inside"] > 0.99
    assert "labels" in result.artifact.arrays("template")
    assert len(load_poses(tmp_path / "s" / "smpl_params.npz")) == 200


@pytest.mark.long
def test_a_capture_without_poses_is_fitted_and_later_stages_get_the_poses(tmp_path: Path) -> None:
    shown = a_pose()
    for frame, down in enumerate((0.9, 0.8, 0.7)):
        shown.rotations[frame, 16, 2], shown.rotations[frame, 17, 2] = -down, down
    capture = write_capture(tmp_path / "person", shown=shown)
    (capture / "takes" / "walk" / "smpl_params.npz").unlink()
    with pytest.raises(MissingInput, match="no body poses"):
        run(capture, tmp_path / "s", TINY)
    result = run(capture, tmp_path / "s", replace(TINY, poses="fit", template="body"))
    assert result.summary["fitted_takes"] == ["walk"]
    take = open_subject_capture(Workspace(tmp_path / "s")).takes[0]
    assert take.posed and take.frames == [0, 1, 2]
    for frame in take.frames:
        truth, found = (posed_body(embedded_body(), poses[frame]) for poses in (shown, take.poses))
        assert np.linalg.norm(truth - found, axis=1).mean() < 0.04


@pytest.mark.long
def test_subject_a_is_found_in_its_scan(subject_a: Path, shared_folder: Path, tmp_path: Path) -> None:
    body = load_body(shared_folder / "body" / "anny_smplx_format.npz")
    fit = fit_scan(body, load_mesh(subject_a / "Sequence1" / "gt" / "scan-f000000.ply"), SILENT)
    truth = State.of(load_poses(subject_a / "Sequence1" / "1x" / "smpl_params.npz")[0])
    joints = bones_of(body, fit.state).joints - bones_of(body, truth).joints
    assert np.linalg.norm(joints[:22], axis=1).mean() < 0.015
    for state in (fit.state, truth):
        state.rotations[:] = 0
        state.translation[:] = 0
    shape = vertices_of(body, fit.state) - vertices_of(body, truth)
    assert np.linalg.norm(shape, axis=1).mean() < 0.005
