"""The model that a bundle's manifest describes: fields, bounds, and shapes, before anything is built."""

from __future__ import annotations

import resource
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.artifacts.bundle import Bundle, decode_bundle
from stages.shared.artifacts.bundle_model import FIELDS, check_model
from stages.shared.avatar.config import PAPER_MODEL, ModelConfig
from stages.shared.errors import BadData
from stages.shared.outfit.layer import check_bundle_model
from tests.hostile.forge import forged, forged_parts
from tests.shared.outfit.wardrobe import bundle, worn


@pytest.fixture(scope="module")
def good() -> Bundle:
    return bundle(worn("upper"))


IMPOSSIBLE: list[tuple[str, Any]] = [
    ("width", 1e9), ("width", 0), ("width", "wide"), ("width", True),
    ("depth", -1), ("depth", 1), ("depth", 63), ("depth", 4.0), ("depth", None),
    ("style", 0), ("style", 10**12), ("style", [64]),
    ("factor", 0), ("factor", -4), ("factor", 0.5), ("factor", 1e9),
    ("anchors", -1), ("anchors", 10**15), ("anchors", {}), ("anchor_cell", 0), ("anchor_cell", 0.1),
    ("anchor_widths", "narrow"), ("history", 9), ("history", -1), ("pose_prior", 10**9), ("pose_prior", "20"),
    ("pose_sigma", -1.0), ("offset_scale", 0), ("max_scale", -0.1),
    ("ranks", [24, 8]), ("ranks", [24, 8, 10**9]), ("ranks", "24,8,4"),
    ("heads", "hydra"), ("networks", ""), ("color", 3), ("input_views", ["both"]),
    ("base", 1), ("normalise", "yes"), ("view_conditioning", None),
    ("texels", 0), ("texels", 10**12), ("texels", True), ("layer", "lower"), ("layer", 3),
    ("blendshapes", {"offset": -1}), ("blendshapes", [1, 2]), ("unheard_of", 1),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), IMPOSSIBLE)
def test_an_impossible_setting_is_refused_by_its_name(name: str, value: Any, good: Bundle) -> None:
    data = bytearray(forged(good, {"model": {**good.manifest["model"], name: value}}))
    with pytest.raises(BadData) as caught:
        decode_bundle(data, "file.gwg")
    assert "file.gwg" in caught.value.where
    assert name in caught.value.where + caught.value.what or name == "layer"


@pytest.mark.parametrize("command", ["verify", "inspect"])
def test_commands_that_only_look_refuse_it_too(command: str, good: Bundle, tmp_path: Path) -> None:
    path = tmp_path / "bad.gwg"
    path.write_bytes(forged(good, {"model": {**good.manifest["model"], "factor": 0}}))
    outcome = CliRunner().invoke(app, [command, str(path)])
    assert outcome.exit_code == 65 and "factor" in outcome.stderr and "bad.gwg" in outcome.stderr


LARGER: list[dict[str, Any]] = [
    {"anchors": 100_000}, {"width": 4, "style": 2048}, {"depth": 8}, {"pose_prior": 4096}, {"factor": 1},
    {"anchors": 9, "history": 3}, {"heads": "separate"}, {"view_conditioning": True}, {"networks": "none"},
    {"decoder": "blendshapes", "blendshapes": {"offset": 256, "color": 256, "form": 256, "centres": 4096}},
]  # fmt: skip


@pytest.mark.parametrize("change", LARGER)
def test_a_possible_model_of_other_tensors_is_refused_before_it_is_built(
    change: dict[str, Any], good: Bundle
) -> None:
    data = bytearray(forged(good, {"model": {**good.manifest["model"], **change}}))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BadData) as caught:
        check_bundle_model(decode_bundle(data, "file.gwg"), "file.gwg")
    assert "file.gwg" in caught.value.where and "wrong shape" in caught.value.what
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 256 * 1024  # KiB


@pytest.mark.parametrize(
    "change",
    [
        {"decoder": "unet"},
        {"decoder": "blendshapes"},
        {"decoder": "blendshapes", "blendshapes": {"offset": 1}},
    ],
)
def test_a_decoder_that_is_unknown_or_without_its_sizes_is_refused(
    change: dict[str, Any], good: Bundle, tmp_path: Path
) -> None:
    path = tmp_path / "bad.gwg"
    path.write_bytes(forged(good, {"model": {**good.manifest["model"], **change}}))
    outcome = CliRunner().invoke(app, ["verify", str(path)])
    assert outcome.exit_code == 65 and "bad.gwg" in outcome.stderr


@pytest.mark.parametrize("name", ["model/base_scale", "model/input_mean", "model/networks.0.fuse.1.bias"])
def test_a_tensor_of_another_shape_is_named(name: str, good: Bundle, tmp_path: Path) -> None:
    arrays = {**good.arrays, name: np.ones((3, 5), np.float32)}
    path = tmp_path / "bad.gwg"
    path.write_bytes(forged_parts(arrays, good.manifest))
    outcome = CliRunner().invoke(app, ["verify", str(path)])
    assert outcome.exit_code == 65 and name.removeprefix("model/") in outcome.stderr


def test_every_setting_has_a_bound_that_its_defaults_keep() -> None:
    assert set(FIELDS) == {field.name for field in fields(ModelConfig)}
    for config in (ModelConfig(), PAPER_MODEL, replace(ModelConfig(), history=3, anchors=40)):
        check_model({**{name: getattr(config, name) for name in FIELDS}, "texels": 5, "layer": "upper"}, "x")
