"""A composite of layers on the CPU that keeps its tile lists for the penetration pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera
from stages.shared.splat.cpu_steps import (
    FlatGaussians,
    PixelBuffers,
    ProjectedView,
    RefusedGaussians,
    Sizes,
    arrange,
    blend_view,
    camera_numbers,
)
from stages.shared.splat.gaussians import Gaussians, Rendering
from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels.penetration import ALONE_CHANNELS, mark_shown, resolve_tiles
from stages.shared.splat.kernels.threads import run_parallel, run_serial
from stages.shared.splat.scene import Scene, check_gaussians, make_scene
from stages.shared.splat.settings import SplatSettings


@dataclass(frozen=True, eq=False)
class LayeredView:
    """One camera's composite, and what it was blended from.

    Attributes:
        rendering: of the composite, one camera, float32; the pass changes it in place.
    """

    rendering: Rendering
    _view: ProjectedView
    _sizes: Sizes
    _layer_ids: NDArray[np.int32]
    _layers: int
    _decided: NDArray[np.int32]  # (H, W) results of earlier pairs, see kernels/penetration.py

    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the tiles that have Gaussians."""
        shape = (-(-self._sizes.height // layout.TILE), self._sizes.columns)
        filled = np.diff(self._view.starts).reshape(shape) > 0
        rows, columns = (np.flatnonzero(filled.any(axis=axis)) * layout.TILE for axis in (1, 0))
        if not len(rows):
            return slice(0, 0), slice(0, 0)
        return (
            slice(int(rows[0]), min(int(rows[-1]) + layout.TILE, self._sizes.height)),
            slice(int(columns[0]), min(int(columns[-1]) + layout.TILE, self._sizes.width)),
        )

    def shown(self, layer: int, box: tuple[slice, slice]) -> NDArray[np.uint8]:
        """(h, w) 1 where a layer shows in the box: has more than half of a pixel that is half covered."""
        rows, columns = box
        shown = np.empty((rows.stop - rows.start, columns.stop - columns.start), np.uint8)
        picture, sizes = self.rendering, self._sizes
        flat = (x.numpy().reshape(-1) for x in (picture.features, picture.alpha))
        run_serial(mark_shown, *flat, layer, sizes.channels, sizes.width, rows.start, columns.start, shown)
        return shown

    def resolve_pair(
        self,
        inside: NDArray[np.uint8],
        inner: int,
        outer: int,
        margin: float,
        opaque: float,
        repaired: NDArray[np.uint8],
    ) -> int:
        """One pair of layers of the penetration pass (`stages/shared/outfit/penetration.py`).

        Arguments:
            inside: (H, W), 1 where the outer layer may take a pixel. margin: m. opaque: alpha.
            repaired: (H, W), set to 1 where the inner layer had shown. Returns how many pixels that are.
        """
        picture, sizes, kind = self.rendering, self._sizes, self._sizes.kind.type
        counts = np.zeros(sizes.tiles, np.int64)
        width, height, _, _, constants, lanes = sizes.kernel_sizes(None)
        run_parallel(
            resolve_tiles, inside.reshape(-1), self._view.starts, self._view.gaussians, self._layer_ids,
            self._view.records, sizes.record, inner, outer, self._layers, kind(margin), kind(opaque),
            *(x.numpy().reshape(-1) for x in (picture.features, picture.alpha, picture.depth)),
            repaired.reshape(-1), self._decided.reshape(-1), counts, width, height, constants, lanes,
            layout.size_argument(2 + ALONE_CHANNELS, True),
        )  # fmt: skip
        return int(counts.sum())


def layered_view(
    gaussians: Gaussians, camera: Camera, settings: SplatSettings = SplatSettings()
) -> LayeredView:
    """Render all layers together, float32, without gradients.

    Raises UsageProblem and BadData as `rasterize_layers` does.
    """
    scene = make_scene(
        gaussians.means, None, None, gaussians.covariances, gaussians.opacities, gaussians.features,
        *camera.tensors(gaussians.means.device), None, camera.width, camera.height,
        gaussians.layer_ids, len(gaussians.layers), (), None, settings,
    )  # fmt: skip
    try:
        return _blended(scene)
    except RefusedGaussians:
        check_gaussians(scene)
        raise


@torch.no_grad()
def _blended(scene: Scene) -> LayeredView:
    channels, place = scene.colors.shape[1], (scene.height, scene.width)
    sizes = Sizes(
        scene.width, scene.height, channels, None, 0, scene.settings, layout.host_lanes()
    )  # fmt: skip
    flat: list[Any] = [
        None if x is None else x.detach().float().contiguous().numpy().reshape(-1)
        for x in (scene.means, None, None, scene.covars, scene.opacities, scene.colors)
    ]
    camera = camera_numbers(scene.viewmats[0].double().numpy(), scene.Ks[0].double().numpy(), sizes)
    view = arrange(FlatGaussians(*flat), camera, np.zeros(channels, sizes.kind), sizes)
    features, alone = torch.empty(1, *place, channels), torch.empty(1, 0, *place, 0)
    alpha, depth = torch.empty(1, 1, *place), torch.empty(1, 1, *place)
    blend_view(view, PixelBuffers.of((features, alone, alpha, depth), 0), None, sizes)
    assert scene.layer_ids is not None
    rendering = Rendering(features[0], alpha[0, 0], depth[0, 0])
    decided = np.zeros(place, np.int32)
    return LayeredView(rendering, view, sizes, scene.layer_ids.numpy(), scene.layers, decided)
