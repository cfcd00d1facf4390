"""Baked maps: images and lists of texels agree; arrays that do not fit are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import BadData
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube, tube_arrays


def test_image_and_list_are_inverse() -> None:
    maps = tube()
    values = torch.randn(len(maps), 5)
    image = maps.to_image(values)
    assert image.shape == (2, 5, *maps.window[2:])
    assert torch.equal(maps.from_image(image), values)
    assert image.abs().sum() == pytest.approx(values.abs().sum().item(), rel=1e-4)


def test_image_puts_a_texel_where_the_grid_says() -> None:
    maps = tube()
    image = maps.to_image(maps.positions)
    row, col = 3, 2
    x = (maps.window[1] + col + 0.5 - GRID / 2) * PITCH
    y = -(maps.window[0] + row + 0.5 - GRID / 2) * PITCH
    for view, sign in ((0, 1), (1, -1)):
        assert image[view, 0, row, col] == pytest.approx(x, abs=1e-6)
        assert image[view, 1, row, col] == pytest.approx(y, abs=1e-6)
        assert sign * image[view, 2, row, col] > 0


def test_arrays_survive_the_round_trip() -> None:
    arrays = tube_arrays()
    back = LayerMaps.from_arrays("body", arrays, PITCH, CENTRE, GRID).arrays()
    assert back.keys() == arrays.keys()
    for name, values in arrays.items():
        assert np.array_equal(back[name], values), name


def test_covered_texels_share_a_pixel() -> None:
    body, shirt = tube(), tube("upper", radius=0.17, low=0.0, high=0.2)
    covered = body.covered_by([shirt])
    expected = (body.positions[:, 1] > 0) & (body.positions[:, 1] < 0.2)
    assert torch.equal(covered, expected)
    assert not body.covered_by([]).any()


def test_a_layer_on_another_grid_covers_the_texels_at_the_same_places() -> None:
    body, shirt = tube(), tube("upper", radius=0.17, low=0.0, high=0.2)
    moved = (0.07, -0.03, 0.0)  # the grid's middle, and what each texel shows, move together
    other = replace(
        shirt,
        pitch=PITCH,
        centre=moved,
        grid_size=GRID + 40,
        texels=shirt.texels + torch.tensor([0, 20, 20]),
    )
    seen = body.positions[:, :2] - torch.tensor(moved[:2])
    expected = (seen[:, 1] > 0) & (seen[:, 1] < 0.2) & (seen[:, 0].abs() < 0.17)
    found = body.covered_by([other])
    edge = torch.minimum((seen[:, 1]).abs(), (seen[:, 1] - 0.2).abs()) < PITCH
    edge |= (seen[:, 0].abs() - 0.17).abs() < PITCH
    assert found.any() and torch.equal(found[~edge], expected[~edge])

    finer = replace(body, pitch=PITCH / 2, texels=body.texels)  # a body half as large, in finer texels
    half = finer.covered_by([shirt])
    assert torch.equal(half, (body.positions[:, 1] > 0))


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("texels", lambda a: a + 1000),
        ("texels", lambda a: a[::-1]),
        ("positions", lambda a: a * np.nan),
        ("neighbours", lambda a: a + 10**6),
        ("seams", lambda a: a - 10**6),
        ("skin_weights", lambda a: a[:, :54]),
        ("window", lambda a: a * 50),
    ],
)
def test_misfits_are_refused(name: str, spoil: object) -> None:
    arrays = tube_arrays()
    arrays[name] = spoil(arrays[name])  # type: ignore[operator]
    with pytest.raises(BadData):
        LayerMaps.from_arrays("body", arrays, PITCH, CENTRE, GRID)


def test_missing_array_is_named() -> None:
    arrays = tube_arrays()
    del arrays["spacing"]
    with pytest.raises(BadData, match="spacing"):
        LayerMaps.from_arrays("body", arrays, PITCH, CENTRE, GRID)
