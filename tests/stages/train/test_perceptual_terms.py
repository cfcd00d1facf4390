"""Training with perceptual weights: the terms are there, and the file is part of the result's name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from stages.shared.artifacts.spec import StageResult
from stages.shared.errors import MissingInput
from stages.shared.losses import perceptual
from stages.train import schedule, stage, trainer
from stages.train.config import TrainConfig
from tests.listening import Listener
from tests.shared.losses.perceptual_weights import random_weights
from tests.stages.train.scene import make_subject, tiny

NARROW = (
    ((0, 3, 4), (2, 4, 4)),
    ((5, 4, 4), (7, 4, 4)),
    ((10, 4, 4), (12, 4, 4), (14, 4, 4)),
    ((17, 4, 4), (19, 4, 4), (21, 4, 4)),
    ((24, 4, 4), (26, 4, 4), (28, 4, 4)),
)


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("perceived"))


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(perceptual, "BLOCKS", NARROW)
    save_file(random_weights(NARROW), tmp_path / "weights.safetensors")
    return tmp_path / "weights.safetensors"


def _losses(result: StageResult) -> dict[str, float]:
    return dict(json.loads(result.artifact.record("metrics.jsonl").splitlines()[-1])["losses"])


def test_the_terms_are_in_the_metrics_with_the_file_only(
    subject: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer, "face_box", lambda camera, centre: (0, 0, camera.width, camera.height))
    config = tiny(steps=2, stage_two=0.0, perceptual_side=32)
    listener = Listener()
    without = stage.run(subject, config, listener)
    assert not {"lpips", "face"} & _losses(without).keys()
    assert len([text for text in listener.said if "LPIPS terms are off" in text]) == 1
    listener = Listener()
    seen = stage.run(subject, config, listener, perceptual_weights=weights)
    assert seen.artifact.key != without.artifact.key and not any("LPIPS" in text for text in listener.said)
    assert _losses(seen)["lpips"] > 0 and _losses(seen)["face"] > 0
    save_file({name: 2 * w for name, w in random_weights(NARROW).items()}, weights)
    assert stage.plan(subject, config, weights).config["perceptual_digest"] != ""
    again = stage.run(subject, config, perceptual_weights=weights)
    assert again.artifact.key != seen.artifact.key


def test_a_face_out_of_sight_is_left_out(subject: Path, weights: Path) -> None:
    config = tiny(steps=2, stage_two=0.0, perceptual_side=16)  # the tubes have no head in the picture
    losses = _losses(stage.run(subject, config, perceptual_weights=weights))
    assert "face" not in losses and losses["lpips"] > 0
    assert all(torch.isfinite(torch.tensor(list(losses.values()))))


def test_the_face_waits_for_the_second_stage() -> None:
    config = TrainConfig(stage_two=0.5)
    first, second = schedule.stage_weights(config, 0.4), schedule.stage_weights(config, 0.6)
    assert (first.lpips, first.face) == (0.1, 0.0) and (second.lpips, second.face) == (0.1, 0.1)


def test_a_file_that_is_not_there_is_said(subject: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingInput):
        stage.run(subject, tiny(), perceptual_weights=tmp_path / "absent.safetensors")
