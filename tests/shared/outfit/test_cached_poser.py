"""Playing an outfit gives the Gaussians of posing it the plain way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.pose import frame_pose, recent_motion
from stages.shared.body import Poses
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from tests.shared.outfit.wardrobe import bundle, motion, worn

NAMED = [(name, bundle(worn(name, source=name))) for name in ("body", "lower", "upper")]


def _same(player: CachedPoser, outfit: Outfit, row: int) -> None:
    poses = motion(5)
    played, plain = player.composite(poses, row), outfit.composite(poses, row)
    assert played.layers == plain.layers and torch.equal(played.layer_ids, plain.layer_ids)
    for name, tolerance in (("means", 5e-6), ("covariances", 1e-7), ("opacities", 1e-6), ("features", 1e-6)):
        assert torch.allclose(getattr(played, name), getattr(plain, name), atol=tolerance), name


@pytest.mark.parametrize("push", [False, True])
def test_playing_is_posing_with_swaps_and_push_out(push: bool) -> None:
    outfit = outfit_of_bundles(NAMED, np.linspace(1, -1, 10, dtype=np.float32), push=push)
    assert outfit.swaps
    player = CachedPoser(outfit)
    for row in (0, 3, 1):
        _same(player, outfit, row)


def test_frames_share_memory_and_a_long_motion_crosses_blocks() -> None:
    outfit = outfit_of_bundles(NAMED[:2])
    poses, player = motion(70), CachedPoser(outfit)
    first = player.composite(poses, 63).means
    late = player.composite(poses, 64).means
    assert late.data_ptr() == first.data_ptr()
    assert torch.allclose(late, outfit.composite(poses, 64).means, atol=5e-6)
    _same(player, outfit, 2)


def test_recent_motion_is_played() -> None:
    """A garment that remembers motion hangs otherwise in a movement than in the same still pose."""
    poses = motion(20)
    dressed = outfit_of_bundles(NAMED[:1])
    piece = worn("upper")
    config = ModelConfig(networks="none", anchors=4, history=2, width=0.0625, depth=2, style=8, factor=4)
    model = StyleUNetDecoder(piece.maps, config)
    bones = [frame_pose(dressed.body_model, *_moment(poses, row)).local_transforms for row in (0, 6, 12, 18)]
    model.fit_input(bones, [recent_motion(poses, row, 2) for row in (0, 6, 12, 18)])
    assert model.anchors is not None
    with torch.no_grad():
        model.anchors.offsets.normal_(0, 0.02, generator=torch.Generator().manual_seed(0))
    model.requires_grad_(False)
    outfit = replace(dressed, layers=(*dressed.layers, replace(piece, model=model)))
    player = CachedPoser(outfit)
    played, plain = player.composite(poses, 12), outfit.composite(poses, 12)
    assert torch.allclose(played.means, plain.means, atol=5e-6)
    still = CachedPoser(outfit).composite(poses[[12]], 0)
    assert (still.means - plain.means).abs().max() > 1e-3


def _moment(poses: Poses, row: int) -> tuple[torch.Tensor, ...]:
    return tuple(torch.from_numpy(a) for a in (poses.rotations[row], poses.translation[row], poses.betas))


def _gaussians(player: CachedPoser, poses: Poses, row: int) -> list[torch.Tensor]:
    found = player.composite(poses, row)
    return [getattr(found, name).clone() for name in ("means", "covariances", "opacities", "features")]


def test_layers_that_stand_still_are_not_posed_again() -> None:
    """The same Gaussians as posing anew, in a motion that stops, goes on and comes back."""
    outfit, poses = outfit_of_bundles(NAMED), motion(5)[[0, 0, 2, 2, 0, 4]]
    lazy, busy = CachedPoser(outfit), CachedPoser(outfit, cache=False)
    for row in range(len(poses)):
        for one, other in zip(_gaussians(lazy, poses, row), _gaussians(busy, poses, row), strict=True):
            assert torch.equal(one, other), row
    assert busy.posed_layers == 6 * 3 and lazy.posed_layers == 4 * 3


def test_a_layer_stays_where_only_joints_move_that_it_does_not_follow() -> None:
    """Body without networks: nothing but its own bones moves it. The tubes follow pelvis and spine."""
    config = ModelConfig(networks="none", width=0.0625, depth=2, style=8, factor=4)
    dressed = outfit_of_bundles(NAMED[:2])
    plain = [replace(layer, model=_without_networks(layer, config)) for layer in dressed.layers]
    outfit = replace(dressed, layers=tuple(plain), swaps=())
    poses = motion(3)[[1, 1, 1]]
    poses.rotations[1, 16] = 0.7  # left shoulder
    poses.rotations[2, 3] += 0.2
    player = CachedPoser(outfit)
    counts = []
    for row in range(3):
        played, wanted = player.composite(poses, row), outfit.composite(poses, row)
        assert torch.allclose(played.means, wanted.means, atol=5e-6)
        assert torch.allclose(played.covariances, wanted.covariances, atol=1e-7)
        assert torch.allclose(played.features, wanted.features, atol=1e-6)
        assert torch.allclose(played.opacities, wanted.opacities, atol=1e-6)
        counts.append(player.posed_layers)
    assert counts == [2, 2, 4]


def _without_networks(layer: WornLayer, config: ModelConfig) -> StyleUNetDecoder:
    model = StyleUNetDecoder(layer.maps, config)
    for name in ("offset", "quaternion", "opacity", "scale", "color"):
        getattr(model, f"base_{name}").data.copy_(getattr(layer.model, f"base_{name}"))
    return model.requires_grad_(False)
