"""Texels that no camera sees: the pose moves them and changes nothing else of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.registry import load_decoder
from stages.shared.avatar.deform import pose_layer
from stages.shared.avatar.pose import FramePose
from stages.shared.avatar.posing import PosedLayer
from stages.shared.errors import BadData
from tests.shared.avatar.test_posing import BETAS, _buffers, _model, _transforms

KINDS = ["blendshapes", "styleunet"]


def _half_observed(kind: str) -> tuple[Decoder, torch.Tensor]:
    model = _model(kind)
    observed = torch.ones(len(model.maps))
    observed[::2] = 0.0
    model.set_observed(observed)
    return model, observed


@pytest.mark.parametrize("kind", KINDS)
@torch.no_grad()
def test_an_unobserved_texel_keeps_its_looks_in_every_pose(kind: str) -> None:
    model, observed = _half_observed(kind)
    pose = _transforms()
    moved, still = model(pose), model.attributes(torch.zeros(len(model.maps), 14))
    hidden = observed == 0
    for name in ("quaternions", "scales", "opacities", "colors"):
        assert torch.equal(getattr(moved, name)[hidden], getattr(still, name)[hidden])
    assert not torch.equal(moved.colors[~hidden], still.colors[~hidden])
    assert not torch.equal(moved.offsets[hidden], still.offsets[hidden])


@pytest.mark.parametrize("kind", KINDS)
@torch.no_grad()
def test_fused_posing_masks_what_the_plain_one_masks(kind: str) -> None:
    model, _ = _half_observed(kind)
    pose = world = _transforms()
    plain, out = pose_layer(model.maps, model(pose), world, BETAS), _buffers(len(model.maps))
    PosedLayer(model, BETAS).pose(FramePose(world, pose, BETAS), out)
    np.testing.assert_allclose(out.means, plain.means, rtol=1e-3, atol=5e-6)
    np.testing.assert_allclose(out.covariances, plain.covariances, rtol=1e-3, atol=2e-7)
    np.testing.assert_allclose(out.opacities, plain.opacities, atol=1e-6)
    np.testing.assert_allclose(out.colors, plain.colors, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_only_a_state_with_unobserved_texels_says_so(kind: str) -> None:
    model, observed = _half_observed(kind)
    state = model.state()
    assert torch.equal(state["observed"], observed)
    again = load_decoder(model.config, model.maps, state)
    assert torch.equal(again.observed, observed) and not again.all_observed
    model.set_observed(torch.ones_like(observed))
    assert "observed" not in model.state()
    assert load_decoder(model.config, model.maps, model.state()).all_observed
    with pytest.raises(BadData):
        load_decoder(model.config, model.maps, {**state, "observed": observed[:-1]})
