"""Pictures teach observed texels only; surface terms teach all of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from stages.train import stage
from stages.train.config import LossWeights
from tests.stages.train.scene import make_subject, tiny

NONE = dict.fromkeys(vars(LossWeights()), 0.0)
PICTURES = LossWeights(**{**NONE, "l1": 1.0, "ssim": 1.0, "label": 1.0})
WITH_SURFACES = replace(PICTURES, smooth=1.0)


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("observed"))


@pytest.mark.parametrize("weights", [PICTURES, WITH_SURFACES], ids=["pictures", "with surfaces"])
def test_gradients_of_unobserved_texels(subject: Path, weights: LossWeights) -> None:
    config = tiny(weights=weights, stage_two=0.0, clip=0.0)
    trainer = stage.prepare(subject, replace(config, model=replace(config.model, networks="none")))
    model = trainer.models["upper"]
    trainer.optimizer.step = lambda closure=None: None  # type: ignore[method-assign]  # gradients alone
    with torch.no_grad():
        model.base_parameters()["offset"].add_(0.003 * torch.randn_like(model.base_offset))
    model.set_observed(torch.ones(len(model.maps)))
    trainer.step(0, 0.0)
    everywhere = model.base_offset.grad.clone()  # type: ignore[union-attr]
    observed = torch.ones(len(model.maps))
    observed[::2] = 0.0
    model.set_observed(observed)
    trainer.step(0, 0.0)
    gradient = model.base_offset.grad
    assert gradient is not None and gradient[1::2].any()
    assert torch.equal(gradient[1::2], everywhere[1::2]) and everywhere[::2].any()
    assert bool(gradient[::2].any()) == (weights is WITH_SURFACES)


def test_a_run_without_picture_terms(subject: Path) -> None:
    config = tiny(weights=LossWeights(**{**NONE, "offset": 1.0}), stage_two=0.0)
    track = replace(config.track, frame_step=1, warm_up=2, cell=2)
    trainer = stage.prepare(subject, replace(config, track=track))
    trainer.warm_up()
    model = trainer.models["upper"]
    with torch.no_grad():
        model.base_parameters()["offset"].add_(0.003)
    report = trainer.step(0, 0.0)
    assert report.finite and set(report.terms) == {"offset", "total"} and report.gradient_norm > 0


def test_warm_up_leaves_unobserved_texels(subject: Path) -> None:
    config = tiny()
    track = replace(config.track, frame_step=1, warm_up=3, cell=2)
    trainer = stage.prepare(subject, replace(config, track=track))
    model = trainer.models["upper"]
    before = model.base_color.detach().clone()
    observed = torch.ones(len(model.maps))
    observed[::2] = 0.0
    model.set_observed(observed)
    trainer.warm_up()
    changed = (model.base_color.detach() - before).abs().sum(dim=1) > 0
    assert changed[1::2].any() and not changed[::2].any()
