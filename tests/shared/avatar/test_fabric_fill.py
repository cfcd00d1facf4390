"""Colours of unseen texels continue the fabric of the seen ones."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.avatar.fabric_fill import continue_fabric
from stages.shared.avatar.maps import LayerMaps

HEIGHT, WIDTH, PERIOD = 36, 24, 6
DARK, LIGHT = np.array([16, 26, 41]) / 255, np.array([237, 237, 230]) / 255


def flat_maps(sheets: int = 2) -> LayerMaps:
    """A rectangle of texels on each of `sheets` sheets, 1 cm apart in depth."""
    view, row, column = (
        part.ravel()
        for part in np.meshgrid(np.arange(sheets), np.arange(HEIGHT), np.arange(WIDTH), indexing="ij")
    )
    count = len(view)
    positions = np.stack([0.01 * column, -0.01 * row, 0.01 * view], axis=1)
    arrays = {
        "texels": np.stack([view, row + 2, column + 3], axis=1),
        "window": np.array([2, 3, HEIGHT, WIDTH]),
        "positions": positions,
        "normals": np.tile([0.0, 0.0, 1.0], (count, 1)),
        "skin_weights": np.eye(55)[np.zeros(count, int)],
        "shape_directions": np.zeros((count, 10, 3)),
        "neighbours": np.full((count, 4), -1),
        "seams": np.zeros((0, 2), int),
        "spacing": np.full(count, 0.006),
        "colors": np.zeros((count, 3)),
        "color_confidence": np.zeros(count),
    }
    return LayerMaps.from_arrays("upper", arrays, 0.01, np.zeros(3), 64)


def stripes(maps: LayerMaps) -> NDArray[np.float64]:
    """(N, 3) horizontal stripes, two rows of each six light."""
    row = maps.texels[:, 1].numpy()
    return np.where((row % PERIOD < 2)[:, None], LIGHT, DARK)


def test_stripes_go_on_where_nothing_was_seen() -> None:
    maps = flat_maps()
    truth = stripes(maps)
    view, _, column = (part.numpy() for part in maps.window_texels)
    seen = (view == 0) & (column < 14)
    noise = np.random.default_rng(0).uniform(0, 1, truth.shape)
    start = torch.from_numpy(np.where(seen[:, None], truth, noise)).float()
    filled = continue_fabric(maps, start, seen).numpy()
    np.testing.assert_array_equal(filled[seen], start.numpy()[seen])
    to_dark, to_light = (np.abs(filled - color).max(axis=1) for color in (DARK, LIGHT))
    assert (np.minimum(to_dark, to_light) < 0.02).all(), "only colours of the fabric"
    light = to_light < 0.02
    assert 0.25 < light[~seen].mean() < 0.42, "as much of each as in the fabric"
    beside = (view == 0) & ~seen
    assert np.abs(filled - truth)[beside].mean() < 0.1, "most stripes meet at the border"


def test_the_same_maps_give_the_same_colours() -> None:
    maps = flat_maps()
    seen = maps.texels[:, 0].numpy() == 0
    colors = torch.from_numpy(stripes(maps)).float()
    assert torch.equal(continue_fabric(maps, colors, seen), continue_fabric(maps, colors, seen))


def test_peeled_sheets_take_the_nearest_outer_texel() -> None:
    maps = flat_maps(sheets=4)
    view = maps.texels[:, 0].numpy()
    colors = torch.from_numpy(np.where(view[:, None] < 2, stripes(maps), 0.5)).float()
    filled = continue_fabric(maps, colors, view < 2)
    torch.testing.assert_close(filled[view == 2], colors[view == 1])
    torch.testing.assert_close(filled[view == 3], colors[view == 1])


def test_too_little_fabric_gives_its_median_and_nothing_seen_changes_nothing() -> None:
    maps = flat_maps()
    seen = np.zeros(len(maps), bool)
    colors = torch.rand(len(maps), 3, generator=torch.Generator().manual_seed(0))
    assert continue_fabric(maps, colors, seen) is colors
    seen[:5] = True
    filled = continue_fabric(maps, colors, seen)
    expected = colors[:5].median(dim=0).values
    torch.testing.assert_close(filled[5:], expected.expand(len(maps) - 5, 3))
    assert continue_fabric(maps, colors, np.ones(len(maps), bool)) is colors
