"""Playing an outfit gives the Gaussians of posing it the plain way."""

from __future__ import annotations

import numpy as np
import pytest
import torch

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
