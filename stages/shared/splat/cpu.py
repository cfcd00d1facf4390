"""The CPU backend: projection by torch, compositing by compiled loops over tiles."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from stages.shared.splat import reference
from stages.shared.splat.rendering import Rendering, stacked
from stages.shared.splat.scene import Scene
from stages.shared.splat.settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

_TILE = 16


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _tile_lists(centers, conics, opacities, members, width, height):  # type: ignore[no-untyped-def]
    columns, rows = (width + _TILE - 1) // _TILE, (height + _TILE - 1) // _TILE
    n = len(centers)
    box = np.empty((n, 4), np.int32)
    start = np.zeros(columns * rows + 1, np.int64)
    for i in range(n):
        box[i, 0], box[i, 2] = 1, 0
        if opacities[i] < ALPHA_MIN or members[i] == 0:
            continue
        det = conics[i, 0] * conics[i, 2] - conics[i, 1] * conics[i, 1]
        reach = 2.0 * math.log(opacities[i] / ALPHA_MIN) + 1e-4
        ex, ey = math.sqrt(reach * conics[i, 2] / det), math.sqrt(reach * conics[i, 0] / det)
        x, y = centers[i, 0], centers[i, 1]
        if not (x + ex > 0 and x - ex < width and y + ey > 0 and y - ey < height):
            continue
        box[i, 0], box[i, 1] = int(max(x - ex, 0.0)) // _TILE, int(max(y - ey, 0.0)) // _TILE
        box[i, 2] = int(min(x + ex, width - 1.0)) // _TILE
        box[i, 3] = int(min(y + ey, height - 1.0)) // _TILE
        for r in range(box[i, 1], box[i, 3] + 1):
            for c in range(box[i, 0], box[i, 2] + 1):
                start[r * columns + c + 1] += 1
    for t in range(columns * rows):
        start[t + 1] += start[t]
    place = start[:-1].copy()
    entries = np.empty(start[-1], np.int32)
    for i in range(n):
        if box[i, 0] > box[i, 2]:
            continue
        for r in range(box[i, 1], box[i, 3] + 1):
            for c in range(box[i, 0], box[i, 2] + 1):
                t = r * columns + c
                entries[place[t]] = i
                place[t] += 1
    return start, entries


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _blend(start, entries, centers, conics, opacities, depths, colors, features, alpha, depth, median):  # type: ignore[no-untyped-def]
    height, width, channels = features.shape
    columns = (width + _TILE - 1) // _TILE
    for r in range(height):
        for c in range(width):
            t = (r // _TILE) * columns + c // _TILE
            left = np.float32(1.0)
            total_depth = np.float32(0.0)
            for e in range(start[t], start[t + 1]):
                i = entries[e]
                dx, dy = c + np.float32(0.5) - centers[i, 0], r + np.float32(0.5) - centers[i, 1]
                power = (
                    np.float32(0.5) * (conics[i, 0] * dx * dx + conics[i, 2] * dy * dy)
                    + conics[i, 1] * dx * dy
                )
                a = min(opacities[i] * math.exp(-power), np.float32(ALPHA_MAX))
                if a < ALPHA_MIN:
                    continue
                after = left * (np.float32(1.0) - a)
                if after <= TRANSMITTANCE_MIN:
                    break
                w = a * left
                for k in range(channels):
                    features[r, c, k] += w * colors[i, k]
                total_depth += w * depths[i]
                if left > 0.5 and after <= 0.5:
                    median[r, c] = depths[i]
                left = after
            alpha[r, c] = np.float32(1.0) - left
            depth[r, c] = total_depth


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _blend_backward(  # type: ignore[no-untyped-def]
    start, entries, centers, conics, opacities, depths, colors, features, alpha, depth,
    g_features, g_alpha, g_depth, g_centers, g_conics, g_opacities, g_depths, g_colors,
):  # fmt: skip
    height, width, channels = features.shape
    columns = (width + _TILE - 1) // _TILE
    for r in range(height):
        for c in range(width):
            t = (r // _TILE) * columns + c // _TILE
            left = np.float32(1.0)
            rest = g_alpha[r, c] * alpha[r, c] + g_depth[r, c] * depth[r, c]
            for k in range(channels):
                rest += g_features[r, c, k] * features[r, c, k]
            for e in range(start[t], start[t + 1]):
                i = entries[e]
                dx, dy = c + np.float32(0.5) - centers[i, 0], r + np.float32(0.5) - centers[i, 1]
                power = (
                    np.float32(0.5) * (conics[i, 0] * dx * dx + conics[i, 2] * dy * dy)
                    + conics[i, 1] * dx * dy
                )
                falloff = math.exp(-power)
                raw = opacities[i] * falloff
                a = min(raw, np.float32(ALPHA_MAX))
                if a < ALPHA_MIN:
                    continue
                after = left * (np.float32(1.0) - a)
                if after <= TRANSMITTANCE_MIN:
                    break
                w = a * left
                value = g_alpha[r, c] + g_depth[r, c] * depths[i]
                for k in range(channels):
                    value += g_features[r, c, k] * colors[i, k]
                    g_colors[i, k] += w * g_features[r, c, k]
                g_depths[i] += w * g_depth[r, c]
                rest -= w * value
                if raw < ALPHA_MAX:
                    g_a = left * value - rest / (np.float32(1.0) - a)
                    g_opacities[i] += g_a * falloff
                    g_power = -g_a * a
                    g_conics[i, 0] += g_power * np.float32(0.5) * dx * dx
                    g_conics[i, 1] += g_power * dx * dy
                    g_conics[i, 2] += g_power * np.float32(0.5) * dy * dy
                    g_centers[i, 0] -= g_power * (conics[i, 0] * dx + conics[i, 1] * dy)
                    g_centers[i, 1] -= g_power * (conics[i, 2] * dy + conics[i, 1] * dx)
                left = after


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, centers: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, colors: Tensor,
        members: Tensor, width: int, height: int,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        arrays = [
            x.detach().float().contiguous().numpy() for x in (centers, conics, opacities, depths, colors)
        ]
        start, entries = _tile_lists(*arrays[:3], members.numpy(), width, height)
        features = np.zeros((height, width, colors.shape[1]), np.float32)
        alpha, depth, median = (np.zeros((height, width), np.float32) for _ in range(3))
        _blend(start, entries, *arrays, features, alpha, depth, median)
        ctx.arrays = (start, entries, *arrays, features, alpha, depth)
        outputs = tuple(torch.from_numpy(x) for x in (features, alpha, depth, median))
        ctx.mark_non_differentiable(outputs[3])
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        incoming = [g.contiguous().numpy() for g in grads[:3]]
        outgoing = [np.zeros_like(x) for x in ctx.arrays[2:7]]
        _blend_backward(*ctx.arrays, *incoming, *outgoing)
        return (*(torch.from_numpy(x) for x in outgoing), None, None, None)


def render_scene(scene: Scene) -> Rendering:
    """Every camera, composite and layers: fields of shape (1 + L, B, H, W, ...)."""
    dtype = scene.means.dtype
    covars = scene.covars if scene.covars is not None else reference.covariances(scene.quats, scene.scales)
    rows: list[list[Rendering]] = [[] for _ in range(1 + scene.layers)]
    for camera in range(len(scene.viewmats)):
        shape = (scene.width, scene.height)
        gaussians = reference.project(
            scene.means,
            covars,
            scene.opacities,
            scene.viewmats[camera],
            scene.Ks[camera],
            *shape,
            scene.settings,
        )
        colors = scene.colors[gaussians.index]
        for row, pictures in enumerate(rows):
            chosen = torch.ones(len(colors), dtype=torch.int8)
            if row:
                chosen = (scene.layer_ids[gaussians.index] == row - 1).to(torch.int8)
            features, alpha, depth, median = _Composite.apply(
                gaussians.centers,
                gaussians.conics,
                gaussians.opacities,
                gaussians.depths,
                colors,
                chosen,
                *shape,
            )
            if scene.background is not None:
                features = features + (1 - alpha)[..., None] * scene.background[camera]
            fields = [x.to(dtype) for x in (features, alpha, depth, median)]
            pictures.append(Rendering(*fields[:3], fields[3] if scene.median else None))
    return stacked(rows)
