"""The template mesh of a subject's layer as glTF."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.export_garment import template_mesh
from stages.export_garment.config import TemplateMeshConfig
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.export.glb import GlbReader
from tests.shared.outfit.wardrobe import tube_mesh, worn


def positions(path: Path) -> np.ndarray:
    glb = GlbReader(path)
    return glb.array(glb.content["meshes"][0]["primitives"][0]["attributes"]["POSITION"])


def test_the_mesh_is_the_subjects_layer(dressed_subject: Path, tmp_path: Path) -> None:
    path, config = tmp_path / "upper.glb", TemplateMeshConfig("upper", own_shape=False)
    found = template_mesh.run(dressed_subject, path, config)
    wanted = tube_mesh(worn("upper"))
    np.testing.assert_allclose(positions(path), wanted["vertices"], atol=1e-6)
    assert found["vertices"] == len(wanted["vertices"]) and found["faces"] == len(wanted["faces"])
    glb = GlbReader(path)
    primitive = glb.content["meshes"][0]["primitives"][0]
    assert np.array_equal(glb.array(primitive["indices"]).reshape(-1, 3), wanted["faces"])
    notes = json.loads((tmp_path / "upper.glb.notes.json").read_bytes())
    assert notes["frame"] == "canonical pose, zero shape" and notes["unit"] == "metre"


def test_command(dressed_subject: Path, wardrobe: Path, tmp_path: Path) -> None:
    mesh = tmp_path / "lower.glb"
    words = ["export-garment", str(dressed_subject), "--layer", "lower", "--mesh", str(mesh), "--json"]
    dry = CliRunner().invoke(app, [*words, "--dry-run"])
    assert json.loads(dry.stdout.splitlines()[-1])["result"]["outputs"][0] == str(mesh)
    assert not list(tmp_path.iterdir())
    done = CliRunner().invoke(app, [*words, "--poses", str(wardrobe / "motion.npz")])
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["result"]["frames"] == 5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lower.glb", "lower.glb.notes.json"]
    assert len(GlbReader(mesh).content["animations"][0]["channels"]) == 56
    both = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "lower.gwg")])
    assert both.exit_code == 0 and (tmp_path / "lower.gwg").is_file()


def test_what_cannot_be_written(dressed_subject: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageProblem, match="glb"):
        template_mesh.run(dressed_subject, tmp_path / "a.obj")
    with pytest.raises(MissingInput, match="outer"):
        template_mesh.run(dressed_subject, tmp_path / "a.glb", TemplateMeshConfig("outer"))
    assert not list(tmp_path.iterdir())
