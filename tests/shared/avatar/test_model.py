"""Layer model: starts at the baked surface, keeps its state, answers to the pose."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.shared.avatar.compose import compose
from stages.shared.avatar.config import PAPER_MODEL, ModelConfig
from stages.shared.avatar.decoders.positional_maps import PositionalMaps, network_grid
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.deform import pose_layer
from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import BadData
from stages.shared.quaternions import matrices_from_quaternions, quaternion_from_z
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube, tube_arrays

SMALL = ModelConfig(width=0.0625, depth=2, style=8, factor=4)
SEPARATE = ModelConfig(
    heads="separate",
    width=0.0625,
    depth=2,
    style=8,
    factor=2,
    input_views="front",
    normalise=False,
    base=False,
    color="linear",
    view_conditioning=True,
)


def _pose(angle: float = 0.0) -> torch.Tensor:
    transforms = torch.eye(4).repeat(55, 1, 1)
    half = torch.tensor([angle / 2])
    turn = torch.stack((half.cos(), half.sin(), half * 0, half * 0), 1)
    transforms[3, :3, :3] = matrices_from_quaternions(turn)[0]
    return transforms


def _learned(model: StyleUNetDecoder) -> StyleUNetDecoder:
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    return model


def test_fresh_model_is_the_baked_surface() -> None:
    maps = tube()
    attributes = StyleUNetDecoder(maps, SMALL)(_pose(0.7))
    assert attributes.offsets.abs().max() == 0
    assert torch.allclose(attributes.colors, maps.colors.clamp(0.02, 0.98), atol=1e-5)
    discs = matrices_from_quaternions(attributes.quaternions)[:, :, 2]
    assert torch.allclose(discs, maps.normals, atol=1e-5)
    assert torch.allclose(attributes.scales[:, 0], maps.spacing, atol=1e-6)


def test_published_constants_without_base_attributes() -> None:
    maps = tube()
    model = StyleUNetDecoder(maps, SEPARATE)
    attributes = model(_pose(), torch.ones(len(maps)))
    assert not model.base_parameters()
    assert torch.allclose(attributes.opacities, torch.full_like(attributes.opacities, 0.5))
    assert torch.allclose(attributes.scales, maps.spacing[:, None].expand(-1, 3), atol=1e-6)
    assert torch.equal(attributes.quaternions, torch.tensor([[1.0, 0, 0, 0]]).expand(len(maps), 4))


def test_published_model_is_called_by_its_sizes() -> None:
    window = (100, 100, 1024, 1024)
    grid = network_grid(window, PAPER_MODEL.factor, PAPER_MODEL.depth)
    assert (grid.height, grid.width) == (512, 512)


@pytest.mark.parametrize("config", [SMALL, SEPARATE, replace(SMALL, anchors=3)])
def test_state_round_trip_is_exact(config: ModelConfig) -> None:
    maps = tube("upper")
    model = StyleUNetDecoder(maps, config, seed=5)
    model.fit_input([_pose(angle) for angle in (-0.4, 0.0, 0.4)])
    _learned(model)
    settings = json.loads(json.dumps(model.config))
    again = StyleUNetDecoder.from_state(settings, maps, model.state())
    first, second = model(_pose(0.4)), again(_pose(0.4))
    for name in ("offsets", "quaternions", "scales", "opacities", "colors"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name


def test_state_of_another_layer_is_refused() -> None:
    model = StyleUNetDecoder(tube(), SMALL)
    other = tube("upper", radius=0.2)
    with pytest.raises(BadData):
        StyleUNetDecoder.from_state(model.config, other, model.state())
    with pytest.raises(BadData):
        StyleUNetDecoder.from_state({**model.config, "width": 0.25}, tube(), model.state())
    with pytest.raises(BadData):
        StyleUNetDecoder.from_state({**model.config, "colour": 1}, tube(), model.state())


def test_output_follows_the_pose_and_every_parameter_gets_a_gradient() -> None:
    maps = tube()
    for config in (SMALL, SEPARATE):
        model = _learned(StyleUNetDecoder(maps, config))
        still = model(_pose(0.0), torch.full((len(maps),), 0.5))
        bent = model(_pose(0.9), torch.full((len(maps),), 0.5))
        assert (still.offsets - bent.offsets).abs().max() > 1e-5
        total = sum(
            (value.square() * torch.randn_like(value)).sum()
            for value in (bent.offsets, bent.quaternions, bent.scales, bent.opacities, bent.colors)
        )
        total.backward()
        for name, parameter in model.named_parameters():
            assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
            assert parameter.grad.abs().sum() > 0, name


def test_anchors_move_garments_in_the_poses_they_belong_to() -> None:
    config = replace(SMALL, anchors=2)
    assert StyleUNetDecoder(tube(), config).anchors is None, "the body follows its bones"
    model = StyleUNetDecoder(tube("upper"), config)
    model.fit_input([_pose(-0.5), _pose(0.5)])
    assert model.anchors is not None
    with torch.no_grad():
        model.anchors.offsets[1, 2] = 0.03  # front, z
    front = model.maps.texels[:, 0] == 0
    own, other = model(_pose(0.5)).offsets, model(_pose(-0.5)).offsets
    assert own[front, 2].min() > 0.02 and own[~front].abs().max() == 0 and own[:, :2].abs().max() == 0
    assert other.abs().max() < 0.2 * own.max(), "a little, as the next anchor"


def test_unknown_poses_fade_to_the_mean_of_known_ones() -> None:
    model = StyleUNetDecoder(tube("upper"), replace(SMALL, anchors=2))
    poses = [_pose(-0.2), _pose(0.2)]
    model.fit_input(poses)
    _learned(model)
    known = [model.residual(pose) for pose in poses]
    model.fit_mean(poses)
    mean = (known[0] + known[1]) / 2
    assert torch.allclose(model.residual(_pose(2.5)), mean, atol=1e-5)
    for before, pose in zip(known, poses, strict=True):
        assert torch.allclose(model.residual(pose), before, atol=1e-5)


def test_view_angle_changes_colour_only() -> None:
    maps = tube()
    model = _learned(StyleUNetDecoder(maps, SEPARATE))
    near, far = model(_pose(), torch.ones(len(maps))), model(_pose(), torch.zeros(len(maps)))
    assert (near.colors - far.colors).abs().max() > 1e-6
    assert torch.equal(near.offsets, far.offsets) and torch.equal(near.scales, far.scales)


def test_positional_map_of_the_canonical_pose_is_the_surface() -> None:
    maps = tube()
    grid = network_grid(maps.window, 1, 2)
    image = PositionalMaps(maps, grid, "both")(torch.eye(4).repeat(55, 1, 1))
    assert image.shape == (1, 6, grid.height, grid.width)
    front = image[0, :3, grid.row : grid.row + maps.window[2], grid.column : grid.column + maps.window[3]]
    assert torch.allclose(front, maps.to_image(maps.positions)[0], atol=1e-6)
    assert image.abs().sum() == pytest.approx(maps.positions.abs().sum().item(), rel=1e-4)


@pytest.mark.parametrize("chosen", [slice(0, 0), slice(0, 1), slice(-1, None)])
def test_layers_of_one_texel_or_none(chosen: slice) -> None:
    arrays = tube_arrays()
    few = {name: a[chosen] for name, a in arrays.items() if name not in ("window", "seams")}
    few["neighbours"] = np.full_like(few["neighbours"], -1)
    few |= {"window": arrays["window"], "seams": np.zeros((0, 2), np.int32)}
    maps = LayerMaps.from_arrays("upper", few, PITCH, CENTRE, GRID)
    model = StyleUNetDecoder(maps, replace(SMALL, anchors=2))
    model.fit_input([_pose(-0.5), _pose(0.5)])
    posed = pose_layer(maps, model(_pose(0.2)), _pose(0.2), torch.zeros(10))
    assert len(posed.means) == len(maps)
    assert torch.isfinite(posed.means).all() and torch.isfinite(posed.normals).all()
    posed.means.sum().backward()


def test_discs_for_any_normal() -> None:
    normals = torch.tensor([[0, 0, 1.0], [0, 0, -1], [1, 0, 0], [0, -1, 0], [0.6, 0, -0.8], [1e-8, 0, -1]])
    assert torch.allclose(matrices_from_quaternions(quaternion_from_z(normals))[:, :, 2], normals, atol=1e-6)


def test_normalised_input_is_the_departure_from_the_mean_pose() -> None:
    maps = tube()
    model = StyleUNetDecoder(maps, SMALL)
    poses = [_pose(angle) for angle in (-0.3, 0.0, 0.3)]
    model.fit_input(poses)
    images = torch.cat([(model.positional(p) - model.input_mean) / model.input_scale for p in poses])
    assert images.mean(dim=0).abs().max() < 1e-5
    used = (model.positional(poses[0]) != 0).any(dim=1)[0]
    assert images[:, :, used].square().mean() == pytest.approx(1.0, rel=1e-3)
    again = StyleUNetDecoder.from_state(model.config, maps, model.state())
    assert torch.equal(again.input_mean, model.input_mean) and torch.equal(
        again.input_scale, model.input_scale
    )
    raw = StyleUNetDecoder(maps, SEPARATE)
    raw.fit_input(poses)
    assert raw.input_mean.abs().max() == 0 and raw.input_scale == 1


def test_compose_labels_every_gaussian() -> None:
    layers = {"body": tube(), "upper": tube("upper", radius=0.2, low=0.0)}
    posed = {
        name: pose_layer(maps, StyleUNetDecoder(maps, SMALL)(_pose()), _pose(), torch.zeros(10))
        for name, maps in layers.items()
    }
    composite = compose(posed)
    assert composite.layers == ("body", "upper")
    assert composite.features.shape == (len(composite.means), 5)
    assert composite.features[:, 3].sum() == len(layers["body"])
    assert torch.equal(composite.features[:, 3:].argmax(dim=1), composite.layer_ids)
