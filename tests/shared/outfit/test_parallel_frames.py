"""Frames side by side are the frames one after the other."""

from __future__ import annotations

import pytest
import torch

from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.parallel_frames import parallel_frames
from stages.shared.outfit.render_image import render_image
from stages.shared.splat.gaussians import Gaussians
from tests.shared.outfit.wardrobe import bundle, cameras, motion, worn

OUTFIT = outfit_of_bundles([(name, bundle(worn(name, source=name))) for name in ("body", "upper")])
POSES = motion(9)


def _picture(player: CachedPoser, row: int) -> bytes:
    composite: Gaussians = player.composite(POSES, row)
    return render_image(composite, cameras()[0]).color.tobytes()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_same_bytes_in_the_same_order(threads: int) -> None:
    rows = list(range(9)) * 2
    player = CachedPoser(OUTFIT)
    expected = [_picture(player, row) for row in rows]
    assert list(parallel_frames(OUTFIT, rows, _picture, threads)) == expected
    assert len(set(expected)) == 9


def test_number_of_threads_is_put_back() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        list(parallel_frames(OUTFIT, range(4), _picture, 2))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_an_error_in_a_frame_reaches_the_caller() -> None:
    def work(player: CachedPoser, row: int) -> int:
        if row == 3:
            raise ValueError("frame 3")
        return row

    with pytest.raises(ValueError, match="frame 3"):
        list(parallel_frames(OUTFIT, range(6), work, 2))


def test_nothing_to_do() -> None:
    assert list(parallel_frames(OUTFIT, [], _picture, 2)) == []
