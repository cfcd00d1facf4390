"""Playing an outfit gives the Gaussians of posing it the plain way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.model import LayerModel
from stages.shared.avatar.motion import recent_motion
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import Poses
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.player import Player
from tests.shared.outfit.wardrobe import bundle, motion, worn

NAMED = [(name, bundle(worn(name, source=name))) for name in ("body", "lower", "upper")]


def _same(player: Player, outfit: Outfit, row: int) -> None:
    poses = motion(5)
    played, plain = player.composite(poses, row), outfit.composite(poses, row)
    assert played.layers == plain.layers and torch.equal(played.layer_ids, plain.layer_ids)
    for name, tolerance in (("means", 5e-6), ("covariances", 1e-7), ("opacities", 1e-6), ("features", 1e-6)):
        assert torch.allclose(getattr(played, name), getattr(plain, name), atol=tolerance), name


@pytest.mark.parametrize("push", [False, True])
def test_playing_is_posing_with_swaps_and_push_out(push: bool) -> None:
    outfit = outfit_of_bundles(NAMED, np.linspace(1, -1, 10, dtype=np.float32), push=push)
    assert outfit.swaps
    player = Player(outfit)
    for row in (0, 3, 1):
        _same(player, outfit, row)


def test_frames_share_memory_and_a_long_motion_crosses_blocks() -> None:
    outfit = outfit_of_bundles(NAMED[:2])
    poses, player = motion(70), Player(outfit)
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
    model = LayerModel(piece.maps, config)
    bones = [frame_pose(dressed.body_model, *_moment(poses, row)).local_transforms for row in (0, 6, 12, 18)]
    model.fit_input(bones, [recent_motion(poses, row, 2) for row in (0, 6, 12, 18)])
    assert model.anchors is not None
    with torch.no_grad():
        model.anchors.offsets.normal_(0, 0.02, generator=torch.Generator().manual_seed(0))
    model.requires_grad_(False)
    outfit = replace(dressed, layers=(*dressed.layers, replace(piece, model=model)))
    player = Player(outfit)
    played, plain = player.composite(poses, 12), outfit.composite(poses, 12)
    assert torch.allclose(played.means, plain.means, atol=5e-6)
    still = Player(outfit).composite(poses[[12]], 0)
    assert (still.means - plain.means).abs().max() > 1e-3


def _moment(poses: Poses, row: int) -> tuple[torch.Tensor, ...]:
    return tuple(torch.from_numpy(a) for a in (poses.rotations[row], poses.translation[row], poses.betas))
