"""Layers with peeled sheets: what networks see of them, what they share with their side, what covers them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.key_poses import sampled_maps
from stages.shared.avatar.decoders.positional_maps import CosineMaps, PositionalMaps, network_grid
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.deform import estimate_normals
from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import BadData
from stages.shared.outfit.coverage import covered_weights
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube, tube_arrays

CONFIG = ModelConfig(width=0.0625, depth=2, style=8, factor=4)


def peeled_arrays(low: float = -0.1, high: float = 0.1) -> dict[str, np.ndarray]:
    """A tube with a smaller one inside it between two heights, on sheets 2 and 3."""
    outer, inner = tube_arrays(), tube_arrays(radius=0.08, low=low, high=high)
    count = len(outer["texels"])
    inner["texels"][:, 0] += 2
    inner["neighbours"] = np.where(inner["neighbours"] >= 0, inner["neighbours"] + count, -1).astype(np.int32)
    inner["seams"] += count
    arrays = {name: np.concatenate([outer[name], inner[name]]) for name in outer if name != "window"}
    return {**arrays, "window": outer["window"]}


@pytest.fixture(scope="module")
def peeled() -> LayerMaps:
    return LayerMaps.from_arrays("upper", peeled_arrays(), PITCH, CENTRE, GRID)


def test_views_sides_and_images(peeled: LayerMaps) -> None:
    assert tube().views == 2 and peeled.views == 4
    assert sum(peeled.view_counts) == len(peeled) and len(peeled.view_counts) == 4
    assert torch.equal(peeled.side, peeled.texels[:, 0] % 2)
    values = torch.randn(len(peeled), 2)
    image = peeled.to_image(values)
    assert image.shape[0] == 4
    assert torch.equal(peeled.from_image(image), values)
    assert len(peeled.pixel_ids().unique()) == len(peeled)


def test_sheets_of_one_side_share_its_map(peeled: LayerMaps) -> None:
    images = torch.stack([torch.full((1, 8, 8), 1.0), torch.full((1, 8, 8), -1.0)])
    found = sampled_maps(images, torch.zeros(len(peeled), 2), peeled.view_counts)[:, 0]
    assert torch.equal(found, 1.0 - 2.0 * peeled.side)


def test_networks_see_only_what_is_met_first(peeled: LayerMaps) -> None:
    plain = tube("upper")
    transforms = torch.eye(4).repeat(55, 1, 1)
    grid = network_grid(plain.window, 4, 2)
    for views in ("front", "both"):
        first = PositionalMaps(plain, grid, views)(transforms)
        assert torch.equal(PositionalMaps(peeled, grid, views)(transforms), first)
    cosines = torch.rand(len(peeled))
    expected = CosineMaps(plain, grid)(cosines[: len(plain)])
    assert torch.allclose(CosineMaps(peeled, grid)(cosines), expected)


@pytest.mark.parametrize("anchors", [0, 2])
def test_residual_is_shared_between_stacked_texels_and_base_attributes_are_not(
    peeled: LayerMaps, anchors: int
) -> None:
    model = StyleUNetDecoder(peeled, ModelConfig(**{**CONFIG.__dict__, "anchors": anchors}))
    with torch.no_grad():
        for parameter in model.networks.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    residual = model.residual(torch.eye(4).repeat(55, 1, 1))
    below = (peeled.texels[:, 0] >= 2).nonzero()[:, 0]
    ids = peeled._side_ids(peeled)
    above = torch.searchsorted(ids[: int((~(peeled.texels[:, 0] >= 2)).sum())], ids[below])
    assert torch.equal(ids[above], ids[below]) and residual[below].std() > 0
    assert torch.allclose(residual[below], residual[above])
    attributes = model.attributes(residual)
    attributes.colors[below].sum().backward()
    assert model.base_color.grad is not None
    assert (model.base_color.grad[below] != 0).all() and (model.base_color.grad[above] == 0).all()


def test_normals_of_peeled_sheets_point_outwards(peeled: LayerMaps) -> None:
    normals = estimate_normals(peeled.positions, peeled, peeled.normals)
    whole = (peeled.neighbours >= 0).all(dim=1) & (peeled.texels[:, 0] >= 2)
    assert whole.any()
    assert ((normals * peeled.normals).sum(dim=1)[whole] > 0.9).all()


def test_a_peeled_piece_of_a_garment_covers_the_body_within(peeled: LayerMaps) -> None:
    body = tube("body", radius=0.06)
    inner_only = LayerMaps.from_arrays("upper", peeled_arrays(), PITCH, CENTRE, GRID)
    height = body.positions[:, 1].numpy()
    weights = covered_weights(body, inner_only, feather=0.0)
    assert (weights[np.abs(height) < 0.05] == 1).all()
    far = peeled_arrays()
    first = far["texels"][:, 0] < 2
    far["positions"][first] += 10 * far["normals"][first]  # what is met first is out of reach
    weights = covered_weights(body, LayerMaps.from_arrays("upper", far, PITCH, CENTRE, GRID), feather=0.0)
    assert (weights[np.abs(height) < 0.05] == 1).all() and (weights[np.abs(height) > 0.15] == 0).all()
    assert torch.equal(body.covered_by([peeled]), body.covered_by([tube("upper")]))


def test_views_out_of_order_or_beyond_the_limit_are_refused() -> None:
    arrays = peeled_arrays()
    arrays["texels"][-1, 0] = 1
    with pytest.raises(BadData, match="later view"):
        LayerMaps.from_arrays("upper", arrays, PITCH, CENTRE, GRID)
    arrays = peeled_arrays()
    arrays["texels"][-1, 0] = 1000
    with pytest.raises(BadData, match="outside"):
        LayerMaps.from_arrays("upper", arrays, PITCH, CENTRE, GRID)
