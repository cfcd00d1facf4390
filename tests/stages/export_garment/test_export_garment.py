"""Exports: whole, repeatable, private, and wearable."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from gw_cli.app import app
from stages.export_garment import stage
from stages.export_garment.config import ExportGarmentConfig
from stages.pipeline import SEGMENT_LAYERS
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.bundle import read_bundle
from stages.shared.avatar.decoders.cost import operations
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.outfit.layer import layer_of_bundle
from tests.shared.outfit.wardrobe import make_subject, worn


@pytest.mark.parametrize("precision", ["float16", "float32"])
def test_the_layer_in_the_file_is_the_trained_one(
    precision: str, dressed_subject: Path, tmp_path: Path
) -> None:
    path = tmp_path / "lower.gwg"
    stage.run(dressed_subject, path, ExportGarmentConfig(precision=precision, preview_size=16))
    layer = layer_of_bundle(read_bundle(path))
    assert read_bundle(path).manifest["costs"]["multiply_adds_per_frame"] == operations(layer.model)
    expected = worn("lower")
    assert layer.name == "lower" and layer.slots == ("lower",)
    still = torch.eye(4).expand(55, 4, 4)
    for name in ("offsets", "quaternions", "scales", "opacities", "colors"):
        found, wanted = getattr(layer.model(still), name), getattr(expected.model(still), name)
        assert torch.allclose(found, wanted, rtol=0, atol=0 if precision == "float32" else 1e-3), name
    assert torch.equal(layer.maps.positions, expected.maps.positions)
    assert torch.equal(layer.maps.spacing, expected.maps.spacing)
    assert torch.allclose(layer.maps.skin_weights.sum(dim=1), torch.ones(len(layer.maps)), atol=1e-6)


def test_half_precision_halves_the_file(dressed_subject: Path, tmp_path: Path) -> None:
    sizes = {}
    for precision in ("float16", "float32"):
        config = ExportGarmentConfig(layer="upper", precision=precision, preview_size=16)
        sizes[precision] = stage.run(dressed_subject, tmp_path / f"{precision}.gwg", config).summary["bytes"]
    assert sizes["float16"] < 0.65 * sizes["float32"]
    with pytest.raises(UsageProblem, match="precision"):
        stage.run(dressed_subject, tmp_path / "x.gwg", ExportGarmentConfig(precision="float8"))


def test_a_dress_takes_the_slots_that_segmentation_found(dressed_subject: Path, tmp_path: Path) -> None:
    subject = tmp_path / "subject"
    shutil.copytree(dressed_subject, subject)
    workspace = Workspace(subject)
    with workspace.build(SEGMENT_LAYERS, ExportGarmentConfig(note="a dress"), {}) as build:
        build.summary(slots={"upper": ["lower", "upper"]})
    config = ExportGarmentConfig(layer="upper", preview_size=16)
    assert stage.run(subject, tmp_path / "dress.gwg", config).summary["slots"] == ["lower", "upper"]
    asked = ExportGarmentConfig(layer="upper", slots=("upper",), preview_size=16)
    assert stage.run(subject, tmp_path / "shirt.gwg", asked).summary["slots"] == ["upper"]
    assert stage.own_slots(subject, ExportGarmentConfig(layer="lower")) == ("lower",)


def test_a_body_says_what_its_covered_skin_is(wardrobe: Path) -> None:
    body, garment = read_bundle(wardrobe / "body.gwg"), read_bundle(wardrobe / "upper.gwg")
    assert np.allclose(body.arrays["joints"], garment.arrays["joints"])
    # The tubes have no hands, so there is no skin to spread from; what is there is tested with them.
    assert not body.group("skin")


def test_a_garment_carries_the_body_beneath_it(wardrobe: Path) -> None:
    bundle = read_bundle(wardrobe / "upper.gwg")
    texels = bundle.arrays["swap/texels"]
    rows = {tuple(row) for row in texels.tolist()}
    body = {tuple(row) for row in worn("body").maps.texels.tolist()}
    assert rows and rows < body
    assert np.abs(bundle.arrays["swap/offsets"]).max() < 0.05
    assert not read_bundle(wardrobe / "body.gwg").group("swap")


def test_two_exports_are_the_same_bytes_and_say_nothing_private(
    dressed_subject: Path, tmp_path: Path
) -> None:
    paths = [tmp_path / "one.gwg", tmp_path / "two.gwg"]
    for path in paths:
        stage.run(dressed_subject, path, ExportGarmentConfig(layer="upper", preview_size=32))
    first, second = (path.read_bytes() for path in paths)
    assert first == second
    for private in (str(dressed_subject), str(tmp_path), Path.home().name, "capture"):
        assert private.encode() not in first, private


def test_preview_shows_the_layer(wardrobe: Path) -> None:
    preview = read_bundle(wardrobe / "lower.gwg").arrays["preview"]
    assert preview.shape == (32, 32, 3)
    assert (preview < 200).any(axis=2).mean() > 0.1


def test_a_dress_takes_two_slots(dressed_subject: Path, tmp_path: Path) -> None:
    config = ExportGarmentConfig(layer="upper", slots=("upper", "lower"), preview_size=32)
    stage.run(dressed_subject, tmp_path / "dress.gwg", config)
    assert read_bundle(tmp_path / "dress.gwg").manifest["slots"] == ["lower", "upper"]


def test_what_cannot_be_exported(dressed_subject: Path, tmp_path: Path) -> None:
    target = tmp_path / "x.gwg"
    for config in (
        ExportGarmentConfig(layer="hat"),
        ExportGarmentConfig(layer="upper", slots=("lower",)),
        ExportGarmentConfig(layer="upper", slots=("upper", "hat")),
        ExportGarmentConfig(layer="body", slots=("upper",)),
    ):
        with pytest.raises(UsageProblem):
            stage.run(dressed_subject, target, config)
    with pytest.raises(MissingInput, match="no layer 'outer'"):
        stage.run(dressed_subject, target, ExportGarmentConfig(layer="outer"))
    untrained = make_subject(tmp_path / "untrained", trained=False)
    with pytest.raises(MissingInput, match="gw train"):
        stage.run(untrained, target, ExportGarmentConfig(layer="upper"))
    assert not target.exists()


def test_command(dressed_subject: Path, tmp_path: Path) -> None:
    target = tmp_path / "skirt.gwg"
    words = ["export-garment", str(dressed_subject), "--layer", "lower", "-o", str(target)]
    dry = CliRunner().invoke(app, [*words, "--dry-run"])
    assert dry.exit_code == 0 and not target.exists() and "skirt.gwg" in dry.stderr
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.stderr
    assert read_bundle(target).layer == "lower" and "gw inspect" in done.stderr
    wrong = CliRunner().invoke(app, [*words[:3], "hat", "-o", str(target)])
    assert wrong.exit_code == 2 and len(wrong.stderr.strip().splitlines()) == 3
