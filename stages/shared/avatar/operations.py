"""What a layer costs to play: multiply-adds per frame by component.

Counted, not measured: of networks from their graph, of the rest from sizes. What a scene does not need is not
there: a layer without networks has no such entry, one without anchors none for them.
"""

from __future__ import annotations

import math

import torch
from torch.utils.flop_counter import FlopCounterMode

from stages.shared.avatar.components import bytes_by_component
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoder import AvatarModel
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.motion import motion_length
from stages.shared.avatar.positional import network_grid
from stages.shared.avatar.used_joints import GROUPS
from stages.shared.nets.styleunet import StyleUNet

_DESCRIBED = 9 * 22  # rotations of the body's joints, as matrices
_MATRIX = 12  # one bone added to a texel's matrix
_POSED = 9 + 27 + 18  # centre, matrix times rotation, its square (six entries)
_PROJECTED = 90  # a Gaussian on the picture: kernels/project.py, counted by hand
_BLENDED = 17 * 31  # 17 a pixel, 31 pixels a Gaussian: 100,000 of them on a person, 512 × 512
_GROUP_WIDTHS = {"offset": 3, "color": 3, "form": 8}


def multiply_adds(
    maps: LayerMaps,
    config: ModelConfig,
    centres: int = 0,
    ranks: tuple[int, int, int] | None = None,
    resting: tuple[str, ...] = (),
) -> dict[str, int]:
    """Multiply-adds of one frame by component, those that are not zero.

    Arguments:
        config: with the number of anchors that there are. centres: of a blendshape kernel.
        ranks: of blendshapes, the configuration's if None.
        resting: groups of joints (`used_joints.GROUPS`) that do not move.
    """
    texels = len(maps)
    counts = {"skinning": _nonzero(maps, resting) * _MATRIX + texels * _POSED}
    counts["splatting at 512 x 512"] = texels * (_PROJECTED + _BLENDED)
    if config.decoder == "blendshapes":
        sizes = dict(zip(_GROUP_WIDTHS, ranks or config.ranks, strict=True))
        described = _DESCRIBED + motion_length(config.history)
        counts["blendshapes"] = texels * sum(_GROUP_WIDTHS[name] * rank for name, rank in sizes.items())
        counts["pose coefficients"] = centres * (described + sum(sizes.values()))
        return {name: count for name, count in counts.items() if count}
    outputs, anchored = config.networks_of(maps.layer), config.anchors > 0 and maps.layer != "body"
    if not outputs and not anchored:
        return counts
    grid = network_grid(maps.window, config.factor, config.depth)
    channels = 3 if config.input_views == "front" else 6
    cells, seen = _cells(maps, config)
    counts["positional map"] = cells * (_MATRIX * joints_used(maps, resting) + 9)
    for count in outputs:
        with torch.device("meta"):
            network = StyleUNet(
                channels, count, (grid.height, grid.width), config.depth, config.width, config.style
            )
            image = torch.empty(1, channels, grid.height, grid.width)
            with FlopCounterMode(display=False) as counted, torch.no_grad():
                network(image)
        counts["networks"] = counts.get("networks", 0) + counted.get_total_flops() // 2
    if outputs and config.pose_prior:
        counts["pose prior"] = 2 * config.pose_prior * channels * seen
    if anchored:
        height, width = (
            math.ceil(side * config.factor / config.anchor_cell) for side in (grid.height, grid.width)
        )
        described = channels * seen + _DESCRIBED + motion_length(config.history)
        counts["anchors"] = config.anchors * (described + 6 * height * width) + 4 * 3 * texels
    return counts


def operations(model: AvatarModel, resting: tuple[str, ...] = ()) -> dict[str, int]:
    """`multiply_adds` of a model as it is."""
    sizes = getattr(model, "sizes", None)
    if sizes is None:
        return multiply_adds(model.maps, model.model_config, resting=resting)
    ranks = (sizes.offset, sizes.color, sizes.form)
    return multiply_adds(model.maps, model.model_config, sizes.centres, ranks, resting)


def joints_used(maps: LayerMaps, resting: tuple[str, ...] = ()) -> int:
    """How many of the 55 joints a layer is skinned with while these groups rest."""
    return int((_merged_weights(maps, resting) != 0).any(dim=0).sum())


def costs(model: AvatarModel, resting: tuple[str, ...] = ()) -> dict[str, object]:
    """What a manifest says of a layer: plain JSON."""
    sizes = {name: tensor.numel() * tensor.element_size() for name, tensor in model.state().items()}
    return {
        "texels": len(model.maps),
        "joints": joints_used(model.maps, resting),
        "multiply_adds_per_frame": operations(model, resting),
        "bytes": bytes_by_component(sizes),
    }


def _merged_weights(maps: LayerMaps, resting: tuple[str, ...]) -> torch.Tensor:
    weights = maps.skin_weights.clone()
    for name in resting:
        members = list(GROUPS[name].members)
        weights[:, GROUPS[name].carrier] += weights[:, members].sum(dim=1)
        weights[:, members] = 0.0
    return weights


def _nonzero(maps: LayerMaps, resting: tuple[str, ...]) -> int:
    return int((_merged_weights(maps, resting) > 1e-6).sum())


def _cells(maps: LayerMaps, config: ModelConfig) -> tuple[int, int]:
    """Pixels of the positional map that have texels: in its views together, and in any of them."""
    grid = network_grid(maps.window, config.factor, config.depth)
    view, row, column = maps.window_texels
    cell = ((row + grid.row) // grid.factor) * grid.width + (column + grid.column) // grid.factor
    shown = view < (2 if config.input_views == "both" else 1)
    pixels = grid.height * grid.width
    cells = torch.unique((view * pixels + cell)[shown])
    return len(cells), len(torch.unique(cells % pixels))
