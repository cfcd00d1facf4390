"""Frames side by side are the frames one after the other."""

from __future__ import annotations

import pytest
import torch

from stages.shared.avatar.compose import Composite
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.picture import take_picture
from stages.shared.outfit.playback import side_by_side
from stages.shared.outfit.player import Player
from tests.shared.outfit.wardrobe import bundle, cameras, motion, worn

OUTFIT = outfit_of_bundles([(name, bundle(worn(name, source=name))) for name in ("body", "upper")])
POSES = motion(9)


def _picture(player: Player, row: int) -> bytes:
    composite: Composite = player.composite(POSES, row)
    return take_picture(composite, cameras()[0]).color.tobytes()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_same_bytes_in_the_same_order(threads: int) -> None:
    rows = list(range(9)) * 2
    player = Player(OUTFIT)
    expected = [_picture(player, row) for row in rows]
    assert list(side_by_side(OUTFIT, rows, _picture, threads)) == expected
    assert len(set(expected)) == 9


def test_number_of_threads_is_put_back() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        list(side_by_side(OUTFIT, range(4), _picture, 2))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_an_error_in_a_frame_reaches_the_caller() -> None:
    def work(player: Player, row: int) -> int:
        if row == 3:
            raise ValueError("frame 3")
        return row

    with pytest.raises(ValueError, match="frame 3"):
        list(side_by_side(OUTFIT, range(6), work, 2))


def test_nothing_to_do() -> None:
    assert list(side_by_side(OUTFIT, [], _picture, 2)) == []
