"""Baked maps of one layer as tensors: which texels there are, and what each knows of the canonical layer.

A texel is one map pixel with a surface point behind it; it carries one Gaussian. Texels live on a window of a
global square grid that all layers and subjects share. Views: 0 front and 1 back are what is met first from
either side; a layer with more to show has further sheets, peeled off below: 2 front and 3 back, and so on.
Even views face the front, odd ones the back.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.shared.errors import BadData
from stages.shared.texel_maps import ARRAYS, FLOATS, OTHER_ARRAYS, index_problem, texel_links

_INDICES = ("texels", "neighbours", "seams")
_LARGEST_GRID = 1 << 15  # texels per side: pixel ids of all views fit into 64 bits


@dataclass(frozen=True)
class LayerMaps:
    """Baked maps of one layer.

    Attributes:
        layer: "body", "lower", "upper" or "outer".
        pitch: metres per texel of the global grid.
        centre: (3,) m, canonical point at the middle of the grid (bounding box of the zero-shape body).
        grid_size: texels per side of the global grid.
        window: (row0, col0, height, width) of the layer on the grid.
        texels: (N, 3) int64 view, row, column on the global grid; sorted by view, row, column.
        positions: (N, 3) m, canonical, zero shape.
        normals: (N, 3) canonical.
        skin_weights: (N, 55), rows sum to 1.
        shape_directions: (N, 10, 3) m per unit of shape, canonical.
        neighbours: (N, 4) int64 texel above, right, below, left on a sheet of the same side; −1 where there
            is none.
        seams: (S, 2) int64 pairs of texels that meet where the surface turns, one facing front, one back.
        spacing: (N,) m, initial standard deviation of a Gaussian, from the surface sampling density.
        colors: (N, 3) sRGB 0..1 projected from the images.
        color_confidence: (N,) 0 where no image saw the texel.
    """

    layer: str
    pitch: float
    centre: tuple[float, float, float]
    grid_size: int
    window: tuple[int, int, int, int]
    texels: Tensor
    positions: Tensor
    normals: Tensor
    skin_weights: Tensor
    shape_directions: Tensor
    neighbours: Tensor
    seams: Tensor
    spacing: Tensor
    colors: Tensor
    color_confidence: Tensor

    @classmethod
    def load(cls, artifact: Any, layer: str) -> LayerMaps:
        """Maps of `layer` from a bake-maps artifact (`stages.shared.artifacts.Artifact`)."""
        summary = artifact.summary
        return cls.from_arrays(
            layer,
            artifact.arrays(f"{layer}.safetensors"),
            summary["pitch"],
            summary["centre"],
            summary["grid_size"],
        )

    @classmethod
    def from_arrays(
        cls, layer: str, arrays: dict[str, np.ndarray], pitch: float, centre: Any, grid_size: int
    ) -> LayerMaps:
        """Maps from named numpy arrays (names and shapes: class docstring).

        Raises BadData where they disagree.
        """
        where = f"maps of layer {layer}"
        _check(arrays, int(grid_size), where)
        tensors = {name: torch.from_numpy(np.array(arrays[name], dtype=np.float32)) for name in FLOATS}
        for name in _INDICES:
            tensors[name] = torch.from_numpy(np.array(arrays[name], dtype=np.int64))
        window = tuple(int(value) for value in arrays["window"])
        centre = tuple(float(value) for value in centre)
        return cls(layer, float(pitch), centre, int(grid_size), window, **tensors)  # type: ignore[arg-type]

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays `from_arrays` reads: float32, indices int32."""
        arrays = {name: getattr(self, name).cpu().numpy() for name in FLOATS}
        for name in _INDICES:
            arrays[name] = getattr(self, name).cpu().numpy().astype(np.int32)
        arrays["window"] = np.array(self.window, dtype=np.int32)
        return arrays

    def __len__(self) -> int:
        return self.texels.shape[0]

    def to(self, device: torch.device | str) -> LayerMaps:
        """The same maps on `device`."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        moved: dict[str, Any] = {name: v.to(device) for name, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **moved)

    @property
    def views(self) -> int:
        """Number of views: 2, or more with peeled sheets; always even."""
        last = int(self.texels[-1, 0]) if len(self) else 0
        return 2 * (last // 2 + 1)

    @property
    def side(self) -> Tensor:
        """(N,) int64: 0 where a texel faces the front, 1 the back, whatever its sheet."""
        return self.texels[:, 0] % 2

    @property
    def view_counts(self) -> list[int]:
        """Texels of each view, in order."""
        return torch.bincount(self.texels[:, 0], minlength=self.views).tolist()

    @property
    def window_texels(self) -> tuple[Tensor, Tensor, Tensor]:
        """View, row and column inside the window of every texel, each (N,) int64."""
        view, row, column = self.texels.unbind(dim=1)
        return view, row - self.window[0], column - self.window[1]

    def to_image(self, values: Tensor) -> Tensor:
        """Per-texel values (N, C) -> images (views, C, height, width) of the window, zero without texel."""
        view, row, column = self.window_texels
        image = values.new_zeros(self.views, self.window[2], self.window[3], values.shape[1])
        image[view, row, column] = values
        return image.permute(0, 3, 1, 2)

    def from_image(self, image: Tensor) -> Tensor:
        """Window images (views, C, height, width) -> per-texel values (N, C)."""
        view, row, column = self.window_texels
        return image.permute(0, 2, 3, 1)[view, row, column]

    def pixel_ids(self) -> Tensor:
        """(N,) int64, one number per view and pixel of the global grid, the same in every layer."""
        view, row, column = self.texels.unbind(dim=1)
        return (view * self.grid_size + row) * self.grid_size + column

    def links(self) -> tuple[np.ndarray, np.ndarray]:
        """Both ends (K,) int64 of every link between texels (`texel_links`)."""
        return texel_links(self.neighbours.cpu().numpy(), self.seams.cpu().numpy())

    def covered_by(self, others: list[LayerMaps]) -> Tensor:
        """(N,) bool: texels whose map pixel also belongs, on the same side, to one of the `others`.

        On a layer with another grid, the pixel that holds the middle of the texel counts.
        """
        covered = torch.zeros(len(self), dtype=torch.bool, device=self.texels.device)
        for other in others:
            covered |= torch.isin(self._side_ids(other), other._side_ids(other))
        return covered

    def _side_ids(self, grid: LayerMaps) -> Tensor:
        """(N,) int64, one number per side and pixel of the grid of `grid`, the same for all sheets."""
        _, row, column = self.texels.unbind(dim=1)
        if (self.pitch, self.centre, self.grid_size) != (grid.pitch, grid.centre, grid.grid_size):
            right, up = (self.centre[axis] - grid.centre[axis] for axis in (0, 1))
            across = ((column + 0.5 - self.grid_size / 2) * self.pitch + right) / grid.pitch
            down = ((row + 0.5 - self.grid_size / 2) * self.pitch - up) / grid.pitch
            row, column = (
                (place + grid.grid_size / 2).floor().long().clamp(-1, grid.grid_size)
                for place in (down, across)
            )
        return (self.side * (grid.grid_size + 2) + row + 1) * (grid.grid_size + 2) + column + 1


def _check(arrays: dict[str, np.ndarray], grid_size: int, where: str) -> None:
    """Refuse arrays that do not fit together, before anything is indexed with them."""
    missing = sorted({*ARRAYS, *OTHER_ARRAYS} - arrays.keys())
    if missing:
        raise _broken(f"The array {missing[0]!r} is missing.", where)
    count = arrays["texels"].shape[0]
    for name, array in ARRAYS.items():
        if arrays[name].shape != (count, *array.shape):
            raise _broken(f"{name} has shape {arrays[name].shape}, not {(count, *array.shape)}.", where)
    for name in FLOATS:
        if not np.isfinite(arrays[name]).all():
            raise _broken(f"{name} holds NaN or infinity.", where)
    if arrays["window"].shape != (4,) or arrays["seams"].ndim != 2 or arrays["seams"].shape[1] != 2:
        raise _broken("window or seams has a wrong shape.", where)
    if (np.diff(arrays["texels"][:, 0]) < 0).any():
        raise _broken("Texels of a later view stand before texels of an earlier one.", where)
    if grid_size > _LARGEST_GRID:
        raise _broken(f"The grid has more than {_LARGEST_GRID} texels per side.", where)
    if problem := index_problem(arrays, grid_size):
        raise _broken(f"{problem[1]}: {problem[0]}.", where)


def _broken(what: str, where: str) -> BadData:
    return BadData(what, where, "Make the maps again with `gw bake-maps`.")
