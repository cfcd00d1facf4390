"""A person in the 4D-DRESS layout through a whole command, cameras turned round and all."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from gw_cli.app import app
from stages.pipeline import REGISTER_TEMPLATE
from stages.register_template.virtual_capture import virtual_capture
from stages.shared.artifacts import Workspace
from stages.shared.body import embedded_body
from stages.shared.capture import open_capture
from stages.shared.capture.open_capture import with_poses
from stages.shared.capture.subject import open_subject_capture
from stages.shared.meshes import RayScene
from stages.shared.report import SILENT
from tests.shared.capture.people import rest_vertices, write_4d_dress_person, write_person


def test_registers_from_its_scan_and_keeps_the_convention(tmp_path: Path) -> None:
    native = write_person(tmp_path / "native")
    root = write_4d_dress_person(native, tmp_path / "00199" / "Inner")
    result = CliRunner().invoke(app, ["register-template", str(root), "-o", str(tmp_path / "subject")])
    assert result.exit_code == 0, result.stderr
    assert "rows 0 and 1 negated" in result.stderr
    workspace = Workspace(tmp_path / "subject")
    template = workspace.require(REGISTER_TEMPLATE)
    assert template.summary["template_source"] == "scan" and template.summary["take"] == "Take3"
    labels = template.arrays("template")["labels"]
    assert set(np.unique(labels)) == {0, 1}
    found, truth = open_subject_capture(workspace).takes[0], open_capture(native).takes[0]
    for name, camera in truth.cameras.items():
        np.testing.assert_allclose(found.cameras[name].camera_from_world, camera.camera_from_world, atol=1e-9)


def test_virtual_cameras_around_its_scans(tmp_path: Path) -> None:
    """Two of two frames have scans with an atlas: left half red, right half green."""
    native = write_person(tmp_path / "native")
    root = write_4d_dress_person(native, tmp_path / "00199" / "Inner")
    meshes = root / "Take3" / "Meshes_pkl"
    vertices = rest_vertices()
    uvs = np.stack([np.where(vertices[:, 0] > 0, 0.25, 0.75), np.full(len(vertices), 0.9)], axis=1)
    content = {"vertices": vertices, "faces": embedded_body().faces, "uvs": uvs}
    atlas = np.zeros((32, 32, 3), np.uint8)
    atlas[:8] = [0, 0, 250]  # v counts from below: what v = 0.9 shows is in the upper rows
    atlas[:8, :16], atlas[:8, 16:] = [250, 0, 0], [0, 250, 0]
    for number in (21, 22):
        (meshes / f"mesh-f{number:05d}.pkl").write_bytes(pickle.dumps(content, protocol=4))
        (meshes / f"atlas-f{number:05d}.pkl").write_bytes(pickle.dumps(atlas, protocol=4))
    given = open_capture(root)
    assert sorted(given.takes[0].scans) == [0, 1]
    folder = virtual_capture(given, tmp_path / "virtual", 5, SILENT, size=(94, 128))
    made = open_capture(folder)
    take = made.takes[0]
    assert len(take.cameras) == 5 and take.frames == [0, 1] and take.scan is not None
    body = RayScene(rest_vertices(), embedded_body().faces)
    for name, camera in take.cameras.items():
        mask = take.mask(name, 1) > 127
        expected = body.render(camera).hit
        assert (mask & expected).sum() / (mask | expected).sum() > 0.98, name
        border = np.r_[mask[0], mask[-1], mask[:, 0], mask[:, -1]]
        assert not border.any(), name  # all of the person is in view
    front = take.image("virtual00", 0)
    columns = np.nonzero(take.mask("virtual00", 0).any(axis=0))[0]
    left, right = front[:, columns[len(columns) // 4]], front[:, columns[3 * len(columns) // 4]]
    # Seen from the front the person's left is on the right.
    assert right[:, 0].max() > 150 > 80 > right[:, 1].max()
    assert left[:, 1].max() > 150 > 80 > left[:, 0].max()
    before = (folder / "capture.json").stat().st_mtime_ns
    assert virtual_capture(given, folder, 5, SILENT, size=(94, 128)) == folder
    assert (folder / "capture.json").stat().st_mtime_ns == before
    assert str(tmp_path) not in (folder / "made_of.json").read_text()
    turned = replace(given.takes[0].poses, rotations=given.takes[0].poses.rotations + 0.01)
    virtual_capture(with_poses(given, {given.takes[0].name: turned}), folder, 5, SILENT, size=(94, 128))
    assert (folder / "capture.json").stat().st_mtime_ns > before
