"""A person in the 4D-DRESS layout through a whole command, cameras turned round and all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from gw_cli.app import app
from stages.pipeline import REGISTER_TEMPLATE
from stages.shared.artifacts import Workspace
from stages.shared.capture import open_capture
from stages.shared.capture.subject import open_subject_capture
from tests.shared.capture.people import write_4d_dress_person, write_person


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
