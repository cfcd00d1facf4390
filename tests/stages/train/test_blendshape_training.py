"""Blendshapes trained directly: they learn, resume, and are worn like any other layer."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from gw_cli.app import app
from stages.export_garment import stage as export
from stages.export_garment.config import ExportGarmentConfig
from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE
from stages.shared.artifacts import Workspace
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.blendshapes import BlendshapeDecoder
from stages.shared.errors import UsageProblem
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.layer import layer_of_training
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.sources import read_bundles
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.train import stage
from stages.train.config import PRESETS, LearningRates, TrackConfig, TrainConfig
from stages.train.resolve import resolve_settings
from tests.stages.train.scene import make_subject, poses, tiny

MODEL = ModelConfig(decoder="blendshapes", ranks=(3, 2, 1), history=2)


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("blendshapes"))


def test_they_learn_and_are_worn(subject: Path, tmp_path: Path) -> None:
    config = tiny(steps=60, model=MODEL, track=TrackConfig(frame_step=1))
    result = stage.run(subject, config)
    lines = [json.loads(line) for line in result.artifact.record("metrics.jsonl").splitlines()]
    assert lines[-1]["losses"]["l1"] < 0.6 * lines[0]["losses"]["l1"]
    assert result.summary["skipped"] == 0
    baked, registered = (Workspace(subject).require(spec) for spec in (BAKE_MAPS, REGISTER_TEMPLATE))
    model = layer_of_training("upper", baked, result.artifact).model
    assert isinstance(model, BlendshapeDecoder)
    for group in ("offset", "color", "form"):
        assert getattr(model, f"basis_{group}").abs().max() > 0, group
    motion = poses()
    trained = TrainedSubject(registered, baked, result.artifact).outfit()
    first, last = (CachedPoser(trained).composite(motion, row) for row in (0, 3))
    assert torch.isfinite(first.means).all() and (first.means - last.means).abs().max() > 1e-3
    bundles = []
    for layer in ("body", "upper"):
        bundles.append(tmp_path / f"{layer}.gwg")
        export.run(subject, bundles[-1], ExportGarmentConfig(layer=layer, preview_size=32))
    worn = outfit_of_bundles(read_bundles(bundles))
    played = CachedPoser(worn).composite(motion, 3)
    assert played.layers == ("body", "upper") and len(played.means) == len(last.means)
    assert np.allclose(played.features[:, :3], last.features[:, :3], atol=0.02)


def test_bases_learn_what_no_single_look_explains(subject: Path) -> None:
    """In half of the poses everything is darker: without bases the difference stays."""
    losses = []
    for ranks in ((3, 2, 1), (0, 0, 0)):
        config = tiny(steps=41, model=replace(MODEL, ranks=ranks), rates=LearningRates(color=0.03))
        trainer = stage.prepare(subject, config)
        for frame in (2, 3):
            for camera in trainer.cameras:
                trainer.views._crop(frame, camera).image[...] //= 2
        for number in range(40):
            trainer.step(number, 0.0)
        losses.append(sum(trainer.step(40 + k, 0.0).terms["l1"] for k in range(4)))
    assert losses[0] < 0.7 * losses[1], losses


def test_their_rates_are_those_of_what_they_move(subject: Path) -> None:
    trainer = stage.prepare(subject, tiny(model=MODEL))
    rates = {group["kind"]: group["start_rate"] for group in trainer.optimizer.param_groups}
    assert trainer.tracker is None and "network" not in rates
    assert rates["basis_offset"] * 0.05 * np.sqrt(3) == pytest.approx(rates["offset"])
    assert rates["basis_color"] * np.sqrt(2) == pytest.approx(rates["color"])
    assert rates["basis_form"] == pytest.approx(min(rates["quaternion"], rates["opacity"], rates["scale"]))
    counted = sum(parameter.numel() for parameter in trainer.parameters.values())
    costs = [m.cost(m.maps, trainer.config.model) for m in trainer.models.values()]
    assert sum(cost.parameters for cost in costs) == counted


def test_what_networks_have_is_left_out() -> None:
    paper = replace(PRESETS["paper"], model=replace(PRESETS["paper"].model, decoder="blendshapes"))
    for config in (
        paper,
        replace(PRESETS["draft"], model=replace(PRESETS["draft"].model, decoder="blendshapes")),
    ):
        once = resolve_settings(config)
        assert resolve_settings(once) == once and once.model.anchors == 0 and once.track.frame_step == 0
        assert once.model.base and not once.model.view_conditioning and once.model.networks == "none"
    with pytest.raises(UsageProblem, match="baseline"):
        resolve_settings(TrainConfig(method="layga", model=ModelConfig(decoder="blendshapes")))


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--decoder", "blendshapes", "--ranks", "4,2,1"], 0),
        (["--networks", "garments", "--network-width", "0.0625"], 0),
        (["--decoder", "magic"], 2),
        (["--networks", "some"], 2),
        (["--ranks", "4,2"], 2),
    ],
)
def test_command(subject: Path, options: list[str], code: int) -> None:
    words = ["train", str(subject), "--preset", "tiny", "--dry-run", "--json", *options]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == code, done.output
    if not code:
        model = json.loads(done.stdout.splitlines()[-1])["result"]["config"]["model"]
        if options[0] == "--decoder":
            assert model["decoder"] == "blendshapes" and model["ranks"] == [4, 2, 1]
        else:
            assert model["networks"] == "garments" and model["width"] == 0.0625
