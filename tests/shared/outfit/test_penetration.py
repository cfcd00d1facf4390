"""The penetration pass on scenes whose answer is known: fixed, kept, kept, untouched."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage

from stages.shared.outfit.penetration import (
    TRYON_MARGINS,
    PenetrationConfig,
    fill_contours,
    resolve_penetration,
)
from stages.shared.splat.gaussians import Rendering

SIZE = 40
LAYERS = ("body", "upper")
RED, BLUE = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])


def _alone(depth: torch.Tensor, color: torch.Tensor, channel: int, count: int) -> Rendering:
    """A flat opaque layer; depth (H, W), infinite where the layer is not."""
    shown = torch.isfinite(depth)
    features = torch.zeros(SIZE, SIZE, 3 + count)
    features[..., :3] = color * shown[..., None]
    features[..., 3 + channel] = shown.float()
    alpha = shown.float()
    return Rendering(features, alpha, torch.where(shown, depth, 0.0))


def _layered(depths: list[torch.Tensor], colors: list[torch.Tensor]) -> Rendering:
    """Layers and their composite: the nearest one wins."""
    alone = [_alone(d, c, k, len(depths)) for k, (d, c) in enumerate(zip(depths, colors, strict=True))]
    nearest = torch.stack(depths).argmin(dim=0)
    features = torch.zeros_like(alone[0].features)
    alpha, depth = torch.zeros(SIZE, SIZE), torch.zeros(SIZE, SIZE)
    for index, part in enumerate(alone):
        own = nearest == index
        features[own], alpha[own], depth[own] = part.features[own], part.alpha[own], part.depth[own]
    return Rendering(features, alpha, depth, layers=tuple(alone))


def _plane(value: float, rows: slice = slice(None), columns: slice = slice(None)) -> torch.Tensor:
    depth = torch.full((SIZE, SIZE), torch.inf)
    depth[rows, columns] = value
    return depth


def test_skin_through_a_hole_in_the_shirt_is_fixed() -> None:
    body, shirt = _plane(2.0), _plane(1.98, slice(5, 35), slice(5, 35))
    body[18:22, 18:22] = 1.97  # one centimetre out of the shirt
    scene = _layered([body, shirt], [RED, BLUE])
    assert torch.allclose(scene.features[20, 20, :3], RED)
    result = resolve_penetration(scene, LAYERS)
    assert torch.allclose(result.rendering.features[20, 20, :3], BLUE)
    assert float(result.rendering.depth[20, 20]) == pytest.approx(1.98)
    assert result.counts == {"body/upper": 16}
    assert result.mask.sum() == 16 and result.mask[18:22, 18:22].all()


def test_an_arm_in_front_of_the_shirt_is_kept() -> None:
    body, shirt = _plane(2.0), _plane(1.98, slice(5, 35), slice(5, 35))
    body[15:20, 10:30] = 1.9
    scene = _layered([body, shirt], [RED, BLUE])
    result = resolve_penetration(scene, LAYERS)
    assert torch.equal(result.rendering.features, scene.features)
    assert result.counts["body/upper"] == 0 and not result.mask.any()


def test_an_arm_in_a_sleeve_opening_is_kept() -> None:
    """The sleeve's far side lies behind the arm, its near side encloses it."""
    shirt = _plane(1.9, slice(5, 35), slice(5, 35))
    shirt[12:28, 12:28] = 2.08
    arm = _plane(1.99, slice(14, 26), slice(14, 26))
    scene = _layered([arm, shirt], [RED, BLUE])
    result = resolve_penetration(scene, LAYERS)
    assert torch.equal(result.rendering.features, scene.features)
    assert not result.mask.any()


def test_without_an_outer_layer_nothing_happens() -> None:
    nothing = torch.full((SIZE, SIZE), torch.inf)
    scene = _layered([_plane(2.0, slice(5, 35)), nothing], [RED, BLUE])
    result = resolve_penetration(scene, LAYERS)
    assert torch.equal(result.rendering.features, scene.features)
    assert result.counts == {"body/upper": 0}
    alone = _layered([_plane(2.0)], [RED])
    assert resolve_penetration(alone, ("body",)).counts == {}


def test_skin_outside_the_outline_is_kept() -> None:
    body, shirt = _plane(2.0), _plane(1.98, slice(5, 35), slice(5, 25))
    scene = _layered([body, shirt], [RED, BLUE])
    result = resolve_penetration(scene, LAYERS)
    assert torch.equal(result.rendering.features[:, 26:], scene.features[:, 26:])


def test_a_garment_in_front_of_another_is_not_taken_for_skin() -> None:
    """Body, lower, upper: the upper's pixels inside the lower's outline belong to the upper."""
    body, lower = _plane(2.0), _plane(1.9, slice(5, 35), slice(5, 35))
    upper = _plane(1.8, slice(15, 25), slice(15, 25))
    green = torch.tensor([0.1, 0.9, 0.1])
    scene = _layered([body, lower, upper], [RED, BLUE, green])
    result = resolve_penetration(scene, ("body", "lower", "upper"))
    assert torch.equal(result.rendering.features, scene.features)
    deep = _plane(2.0), _plane(1.9, slice(5, 35), slice(5, 35)), _plane(1.93, slice(10, 30), slice(10, 30))
    poking = _layered(list(deep), [RED, BLUE, green])
    poking.features[12:28, 12:28] = torch.tensor([*green.tolist(), 0.0, 0.0, 1.0])
    poking.features[18:20, 18:20, 3:] = torch.tensor([0.0, 1.0, 0.0])
    found = resolve_penetration(poking, ("body", "lower", "upper"))
    assert found.counts["lower/upper"] == 4


def test_the_margin_decides() -> None:
    body, shirt = _plane(2.0), _plane(1.98, slice(5, 35), slice(5, 35))
    body[18:22, 18:22] = 1.94
    scene = _layered([body, shirt], [RED, BLUE])
    assert resolve_penetration(scene, LAYERS).counts["body/upper"] == 0
    assert resolve_penetration(scene, LAYERS, PenetrationConfig(body_margin=0.05)).counts["body/upper"] == 16


@pytest.mark.parametrize("seed", range(5))
def test_enclosed_is_filling_holes_and_eroding(seed: int) -> None:
    random = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(random.normal(size=(64, 80)), 3)
    shown = noise > 0.02
    filled = ndimage.binary_fill_holes(shown)
    expected = ndimage.binary_erosion(filled, np.ones((3, 3)), iterations=2)
    assert np.array_equal(fill_contours(shown, 2), expected)
    assert np.array_equal(fill_contours(shown, 0), filled)
    assert not fill_contours(np.zeros((5, 5), bool), 2).any()


def test_four_layers_in_order_each_repaired_by_its_own_outer() -> None:
    """Body through trousers, shirt through coat: each pixel takes the layer that should hide it."""
    names = ("body", "lower", "upper", "outer")
    body = _plane(2.0, slice(2, 38), slice(2, 38))
    lower, upper = _plane(1.98, slice(20, 38), slice(2, 38)), _plane(1.97, slice(2, 20), slice(2, 38))
    outer = _plane(1.95, slice(4, 18), slice(4, 36))
    body[26:30, 10:14] = 1.96
    upper[8:12, 10:14] = 1.93
    green, white = torch.tensor([0.1, 0.9, 0.1]), torch.tensor([0.9, 0.9, 0.9])
    scene = _layered([body, lower, upper, outer], [RED, BLUE, green, white])
    result = resolve_penetration(scene, names)
    assert {pair: count for pair, count in result.counts.items() if count} == {
        "body/lower": 16,
        "upper/outer": 16,
    }
    assert torch.allclose(result.rendering.features[28, 12, :3], BLUE)
    assert torch.allclose(result.rendering.features[10, 12, :3], white)
    assert result.mask.sum() == 32


def test_try_on_margins_fix_more_and_still_keep_an_arm() -> None:
    body, shirt = _plane(2.0), _plane(1.98, slice(5, 35), slice(5, 35))
    body[12:14, 12:14] = 1.94  # four centimetres out: a thigh through a foreign skirt
    body[22:26, 10:30] = 1.86  # twelve: an arm
    scene = _layered([body, shirt], [RED, BLUE])
    assert resolve_penetration(scene, LAYERS).counts["body/upper"] == 0
    repaired = resolve_penetration(scene, LAYERS, TRYON_MARGINS)
    assert repaired.counts["body/upper"] == 4
    assert torch.equal(repaired.rendering.features[22:26, 10:30], scene.features[22:26, 10:30])
