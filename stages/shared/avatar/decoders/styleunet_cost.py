"""What the decoder "styleunet" needs, counted before it is made."""

from __future__ import annotations

import math

import torch
from torch.utils.flop_counter import FlopCounterMode

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.base import DecoderCost
from stages.shared.avatar.decoders.positional_maps import NetworkGrid, network_grid
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import motion_length
from stages.shared.layers import BODY
from stages.shared.nets.styleunet import StyleUNet, ViewNet

_FLOAT = 4
_BASE_CHANNELS = 14
_ROTATIONS = 9 * 22  # of the body's joints, as matrices
_MATRIX = 12  # multiply-adds of one bone in a cell's matrix
# Measured on two cores, forward and backward: per network of any size, and per weight and input pixel.
_SECONDS_PER_NETWORK = 0.05
_SECONDS_PER_WEIGHT_PIXEL = 1.2e-12
# Counted in the graph of a StyleUNet: activations kept, in units of its widest level (64 channels times width
# at input size); those that do not widen with the rest; modulated weights kept, in units of the weights.
_ACTIVATIONS, _ACTIVATIONS_OVER_WIDTH, _MODULATED = 36.5, 1.1, 1.6


def cost(maps: LayerMaps, config: ModelConfig) -> DecoderCost:
    """As `Decoder.cost`."""
    grid, sizes = _grid(maps, config), _network_sizes(maps, config)
    outputs = config.networks_of(maps.layer)
    base = _BASE_CHANNELS * len(maps) if config.base else 0
    height, width = key_pose_map(grid, config)
    key_poses = 6 * config.anchors * height * width if maps.layer != BODY else 0
    work = sum(sizes) * grid.height * grid.width * _SECONDS_PER_WEIGHT_PIXEL
    widest = grid.height * grid.width * 64 * config.width
    activations = widest * (_ACTIVATIONS + _ACTIVATIONS_OVER_WIDTH / config.width)
    values = 0.0
    if config.pose_prior and outputs:
        values = _channels(config) * min(grid.height * grid.width, len(maps) / config.factor**2)
    return DecoderCost(
        parameters=base + sum(sizes) + key_poses,
        seconds=len(outputs) * _SECONDS_PER_NETWORK + work,
        activation_bytes=tuple(_FLOAT * (activations + _MODULATED * size) for size in sizes[: len(outputs)]),
        fit_values=values,
    )


def multiply_adds(maps: LayerMaps, config: ModelConfig, joints: int) -> dict[str, int]:
    """As `Decoder.multiply_adds`: networks are counted from their graph, the rest from sizes."""
    outputs, has_key_poses = config.networks_of(maps.layer), config.anchors > 0 and maps.layer != BODY
    if not outputs and not has_key_poses:
        return {}
    grid, channels = _grid(maps, config), _channels(config)
    cells, pixels = _used_pixels(maps, config, grid)
    counts = {"positional map": cells * (_MATRIX * joints + 9)}
    for count in outputs:
        with torch.device("meta"):
            network = StyleUNet(
                channels, count, (grid.height, grid.width), config.depth, config.width, config.style
            )
            image = torch.empty(1, channels, grid.height, grid.width)
            with FlopCounterMode(display=False) as counter, torch.no_grad():
                network(image)
        counts["networks"] = counts.get("networks", 0) + counter.get_total_flops() // 2
    if outputs and config.pose_prior:
        counts["pose prior"] = 2 * config.pose_prior * channels * pixels
    if has_key_poses:
        height, width = key_pose_map(grid, config)
        description = channels * pixels + _ROTATIONS + motion_length(config.history)
        counts["anchors"] = config.anchors * (description + 6 * height * width) + 4 * 3 * len(maps)
    return counts


def _grid(maps: LayerMaps, config: ModelConfig) -> NetworkGrid:
    return network_grid(maps.window, config.factor, config.depth)


def _channels(config: ModelConfig) -> int:
    return 3 if config.input_views == "front" else 6


def key_pose_map(grid: NetworkGrid, config: ModelConfig) -> tuple[int, int]:
    """Height and width of one side of a key pose's offset map."""
    height, width = (
        math.ceil(side * config.factor / config.anchor_cell) for side in (grid.height, grid.width)
    )
    return height, width


def _network_sizes(maps: LayerMaps, config: ModelConfig) -> list[int]:
    """Parameters of every network of a layer, and last of the network that shows it the view."""
    grid, outputs = _grid(maps, config), config.networks_of(maps.layer)
    with torch.device("meta"):
        networks: list[torch.nn.Module] = [
            StyleUNet(
                _channels(config), count, (grid.height, grid.width), config.depth, config.width, config.style
            )
            for count in outputs
        ]
        if outputs and config.view_conditioning:
            networks.append(ViewNet(config.width))
    return [sum(p.numel() for p in network.parameters()) for network in networks]


def _used_pixels(maps: LayerMaps, config: ModelConfig, grid: NetworkGrid) -> tuple[int, int]:
    """Pixels of the positional map that have texels: summed over its views, and in any of them."""
    view, row, column = maps.window_texels
    cell = ((row + grid.row) // grid.factor) * grid.width + (column + grid.column) // grid.factor
    shown = view < (2 if config.input_views == "both" else 1)
    pixels = grid.height * grid.width
    cells = torch.unique((view * pixels + cell)[shown])
    return len(cells), len(torch.unique(cells % pixels))
