"""Poses unlike all training poses are projected for the networks, and only those."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.pose_prior import PosePrior
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import Poses, embedded_body
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.outfit import Outfit
from tests.shared.avatar.test_model import SMALL, _learned, _pose
from tests.shared.avatar.tubes import tube


def _maps(count: int = 40, size: int = 30) -> torch.Tensor:
    """Maps spread along two directions, three times and once."""
    generator = torch.Generator().manual_seed(0)
    spread = torch.randn(count, 2, generator=generator) * torch.tensor([3.0, 1.0])
    basis = torch.linalg.qr(torch.randn(size, 2, generator=generator))[0].T
    return 5 + spread @ basis


def test_directions_are_those_of_the_covariance() -> None:
    maps = _maps()
    prior = PosePrior(4, maps.shape[1], 2.0)
    prior.fit(maps)
    values, vectors = np.linalg.eigh(np.cov(maps.double().numpy().T))
    assert (prior.deviations > 0).sum() == 2, "what is noise is left out"
    assert np.allclose(prior.deviations[:2], np.sqrt(values[::-1][:2]), rtol=1e-4)
    agreement = np.abs((prior.directions[:2].double().numpy() * vectors[:, ::-1][:, :2].T).sum(axis=1))
    assert np.allclose(agreement, 1, atol=1e-4)


def test_only_poses_outside_are_changed() -> None:
    maps = _maps()
    prior = PosePrior(4, maps.shape[1], 2.0)
    assert torch.equal(prior(100 * maps[0]), 100 * maps[0]), "nothing before it has seen the training"
    prior.fit(maps)
    inside = [not prior.outside(one) for one in maps]
    assert sum(inside) >= 39 and all(torch.equal(prior(one), one) for one in maps[inside])
    far = prior.mean + 50 * prior.directions[0] + 0.5 * prior.directions[1]
    aside = torch.linalg.qr(torch.cat((prior.directions[:2], torch.randn(1, 30))).T)[0][:, 2]
    found = prior(far + 7 * aside)
    expected = prior.mean + 2 * prior.deviations[0] * prior.directions[0] + 0.5 * prior.directions[1]
    assert torch.allclose(found, expected, atol=1e-4), "held at sigma, freed of what was never seen"
    assert torch.allclose(prior(found), found, atol=1e-4)


@pytest.mark.parametrize("maps", [torch.ones(2, 8), torch.ones(5, 8)])
def test_no_spread_no_prior(maps: torch.Tensor) -> None:
    prior = PosePrior(4, 8, 2.0)
    prior.fit(maps)
    assert torch.equal(prior(torch.full((8,), 9.0)), torch.full((8,), 9.0))


@pytest.mark.parametrize("anchors", [0, 3])
def test_a_layer_sees_the_projection_of_an_unusual_pose(anchors: int) -> None:
    config = replace(SMALL, pose_prior=4, pose_sigma=2.0, anchors=anchors)
    maps = replace(tube(), layer="upper")
    poses = [_pose(angle) for angle in np.linspace(-0.2, 0.2, 9)]
    with_prior = StyleUNetDecoder(maps, config)
    without = StyleUNetDecoder(maps, replace(config, pose_prior=0))
    for model in (with_prior, without):
        model.fit_input(poses)
        _learned(model)
    usual, unusual = _pose(0.03), _pose(1.2)
    assert torch.equal(with_prior.residual(unusual), without.residual(unusual)), "off during training"
    for model in (with_prior, without):
        model.fit_mean(poses)
    assert not with_prior.projected(usual) and with_prior.projected(unusual)
    assert not without.projected(unusual)
    assert torch.equal(with_prior.residual(usual), without.residual(usual))
    changed = (with_prior.residual(unusual) - without.residual(unusual)).abs().max()
    assert changed > 0 if anchors == 0 else changed >= 0
    again = StyleUNetDecoder.from_state(with_prior.config, maps, with_prior.state())
    assert torch.equal(again.residual(unusual), with_prior.residual(unusual)) and again.projected(unusual)


def _bent(*angles: float) -> Poses:
    rotations = np.zeros((len(angles), 55, 3), np.float32)
    rotations[:, 3, 0] = angles
    zeros = np.zeros((len(angles), 10), np.float32)
    return Poses(rotations, zeros[:, :3], zeros[0], zeros)


def test_an_outfit_counts_projected_frames() -> None:
    body, betas, trained = embedded_body(), np.zeros(10, np.float32), _bent(*np.linspace(-0.2, 0.2, 9))
    model = StyleUNetDecoder(tube(), replace(SMALL, pose_prior=4))
    plain = StyleUNetDecoder(replace(tube(), layer="upper"), SMALL)
    seen = [
        frame_pose(body, torch.from_numpy(row), torch.zeros(3), torch.zeros(10)).local_transforms
        for row in trained.rotations
    ]
    model.fit_mean(seen)
    layers = (WornLayer("body", (), model.maps, model), WornLayer("upper", ("upper",), plain.maps, plain))
    poses = _bent(0.0, 0.1, 1.5, -1.5)
    assert Outfit(body, betas, layers).projected_frames(poses, range(4)) == {"body": 2}
    assert Outfit(body, betas, layers).projected_frames(poses, [0, 2]) == {"body": 1}
    assert Outfit(body, betas, layers[1:]).projected_frames(poses, range(4)) == {}


def test_the_default_shape_has_none() -> None:
    assert ModelConfig().pose_prior == 0 and StyleUNetDecoder(tube(), SMALL).prior is None
