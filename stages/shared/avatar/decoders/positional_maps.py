"""Posed positional maps: where each texel's surface point goes in a pose, as an image for the network.

P = Σ_j w_j M_j C with zero shape and without root rotation and translation (Animatable Gaussians, sec. 3.2;
Gaussian Wardrobe, sec. 3.2). The maps are made on the network's own pixel grid: one network pixel stands for
`factor` × `factor` texels, whose mean position and mean skinning weights it poses. Nothing per frame is
stored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from stages.shared.avatar.deform import blended, moved
from stages.shared.avatar.maps import LayerMaps


@dataclass(frozen=True)
class NetworkGrid:
    """How a layer's window lies on the network's input image.

    Attributes:
        height, width: input size in pixels, multiples of 2^depth. factor: texels per input pixel and axis.
        row, column: texel offset of the window inside the padded image (the window is centred).
    """

    height: int
    width: int
    factor: int
    row: int
    column: int


def network_grid(window: tuple[int, int, int, int], factor: int, depth: int) -> NetworkGrid:
    """Smallest padded grid that holds a window (row0, col0, height, width) of texels."""
    multiple = factor * 2**depth
    height = max(1, math.ceil(window[2] / multiple)) * 2**depth
    width = max(1, math.ceil(window[3] / multiple)) * 2**depth
    row, column = (height * factor - window[2]) // 2, (width * factor - window[3]) // 2
    return NetworkGrid(height, width, factor, row, column)


class PositionalMaps(nn.Module):
    """Makes the network's input for a pose; holds no parameters.

    `input_views` is "front" (3 channels) or "both" (6 channels: front, back). Only what is met first from
    either side is shown; peeled sheets are not.
    """

    cells: Tensor  # (M,) int64, pixels of the input image that have texels
    used: Tensor  # (K,) int64, pixels that have texels in any view that is shown
    positions: Tensor  # (M, 3) m
    weights: Tensor  # (M, 55)
    centre: Tensor  # (3,) m

    def __init__(self, maps: LayerMaps, grid: NetworkGrid, input_views: str = "front") -> None:
        super().__init__()
        self.grid = grid
        self.channels = 3 if input_views == "front" else 6
        view, row, column = maps.window_texels
        cell = ((row + grid.row) // grid.factor) * grid.width + (column + grid.column) // grid.factor
        used = view < (2 if input_views == "both" else 1)
        cells, member = torch.unique((view * grid.height * grid.width + cell)[used], return_inverse=True)
        self.register_buffer("cells", cells, persistent=False)
        pixels = torch.unique(cells % (grid.height * grid.width))
        self.register_buffer("used", pixels, persistent=False)
        self.register_buffer(
            "positions", _mean_by(member, maps.positions[used], len(cells)), persistent=False
        )
        self.register_buffer(
            "weights", _mean_by(member, maps.skin_weights[used], len(cells)), persistent=False
        )
        self.register_buffer("centre", torch.tensor(maps.centre, dtype=torch.float32), persistent=False)

    def forward(self, local_transforms: Tensor) -> Tensor:
        """(55, 4, 4) bone transforms (zero shape, no root) -> (1, channels, height, width) m, zeros outside.

        Positions are relative to the grid's centre, which keeps them within about ±1.
        """
        posed = moved(self.positions, blended(self.weights, local_transforms)) - self.centre
        views = self.channels // 3
        image = posed.new_zeros(views * self.grid.height * self.grid.width, 3)
        image = image.index_copy(0, self.cells, posed)
        image = image.view(views, self.grid.height, self.grid.width, 3).permute(0, 3, 1, 2)
        return image.reshape(1, self.channels, self.grid.height, self.grid.width)


def _mean_by(member: Tensor, values: Tensor, count: int) -> Tensor:
    """Mean of the rows of `values` (N, C) that share a `member` (N,) -> (count, C)."""
    total = values.new_zeros(count, values.shape[1]).index_add_(0, member, values)
    number = values.new_zeros(count).index_add_(0, member, values.new_ones(len(values)))
    return total / number[:, None]


class CosineMaps(nn.Module):
    """Mean of a per-texel value over each network pixel, as an image per side; zeros outside.

    Peeled sheets do not take part: the image shows what is met first.
    """

    first: Tensor  # (M,) int64, texels that are met first
    cell: Tensor  # (M,) int64
    number: Tensor  # pixels of both views, texels in each

    def __init__(self, maps: LayerMaps, grid: NetworkGrid) -> None:
        super().__init__()
        self.grid = grid
        view, row, column = maps.window_texels
        cell = ((row + grid.row) // grid.factor) * grid.width + (column + grid.column) // grid.factor
        first = (view < 2).nonzero()[:, 0]
        cell = (view * grid.height * grid.width + cell)[first]
        number = maps.positions.new_zeros(2 * grid.height * grid.width)
        number.index_add_(0, cell, maps.positions.new_ones(len(cell)))
        self.register_buffer("first", first, persistent=False)
        self.register_buffer("cell", cell, persistent=False)
        self.register_buffer("number", number.clamp(min=1), persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        """(N,) -> (2, 1, height, width)."""
        total = torch.zeros_like(self.number).index_add(0, self.cell, values[self.first])
        return (total / self.number).view(2, 1, self.grid.height, self.grid.width)
