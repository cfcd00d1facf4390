"""Poses an outfit fast: frame after frame of Gaussians, written into the same memory.

`Outfit.composite` is the plain version of `CachedPoser.composite`. It allocates what it returns and estimates
normals. A test compares the two. `Poser` is what both are.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.avatar.pose import FramePose, pose_at, recent_motions
from stages.shared.avatar.posing import PosedBuffers, PosedLayer
from stages.shared.body import Poses
from stages.shared.layers import BODY
from stages.shared.outfit.outfit import Outfit
from stages.shared.splat.gaussians import Gaussians

_BLOCK = 64  # rows whose bones are posed together; one row at a time costs as much as a layer


class Poser(Protocol):
    """Poses an outfit."""

    def composite(self, poses: Poses, frame: int) -> Gaussians:
        """All Gaussians in the pose of a row of `poses`."""


class CachedPoser:
    """Poses an outfit fast. What depends on the wearer's shape but not on the pose is computed once, here.

    Arguments:
        outfit: what is worn.
        share_with: another poser of it, whose prepared layers are shared; buffers are not, so that two
            threads can pose two frames.
        hidden: (N,) texels of the body that are left out (`find_hidden_texels`); those of `share_with` when
            that is given.
        cache: whether a layer that did not move since the last frame keeps its Gaussians.

    Attributes:
        posed_layers: number of layers posed so far, without those that kept their Gaussians.
    """

    def __init__(
        self,
        outfit: Outfit,
        share_with: CachedPoser | None = None,
        hidden: NDArray[np.bool_] | None = None,
        cache: bool = True,
    ) -> None:
        self.outfit, self.cache, self.posed_layers = outfit, cache, 0
        # Collision correction needs normals, baselines have labels per texel: these take the plain way.
        self.plain = bool(outfit.corrections) or any(layer.layer_ids is not None for layer in outfit.layers)
        self._bones: tuple[Poses, int, FramePose] | None = None
        self._motions: dict[int, Tensor] = {}  # of the same rows, by number of memories
        self._layers: list[PosedLayer] = (
            _prepared(outfit, hidden) if share_with is None else share_with._layers
        )
        self._gaussians, self._buffers = _buffers(outfit.names, [layer.count for layer in self._layers])
        self._shown: list[tuple[Tensor, ...] | None] = [None] * len(self._layers)  # inputs of the buffers

    @torch.no_grad()
    def composite(self, poses: Poses, frame: int) -> Gaussians:
        """All Gaussians in the pose of a row of `poses`; overwritten by the next call."""
        if self.plain:
            return self.outfit.composite(poses, frame)
        pose = self._pose(poses, frame)
        for index, (layer, buffers) in enumerate(zip(self._layers, self._buffers, strict=True)):
            motion = self._motions[layer.history][frame % _BLOCK] if layer.history else None
            matrices = self.outfit.driver(self.outfit.layers[index]).matrices(poses, frame)
            inputs = layer.depends_on(pose, motion, matrices)
            if self.cache and _same(self._shown[index], inputs):
                continue
            self._shown[index] = None  # until the buffers are whole
            layer.pose(pose, buffers, motion, matrices)
            self._shown[index] = tuple(part.clone() for part in inputs)
            self.posed_layers += 1
        return self._gaussians

    def _pose(self, poses: Poses, frame: int) -> FramePose:
        """The bones of one row, taken from its block of rows; recent motion is computed with them."""
        first = frame - frame % _BLOCK
        if self._bones is None or self._bones[0] is not poses or self._bones[1] != first:
            rows_of_block = slice(first, first + _BLOCK)
            pose = pose_at(self.outfit.body_model, poses, rows_of_block, self.outfit.betas)
            self._bones = (poses, first, pose)
            rows = range(first, min(first + _BLOCK, len(poses)))
            histories = {layer.history for layer in self._layers if layer.history}
            self._motions = {history: recent_motions(poses, rows, history) for history in histories}
        block = self._bones[2]
        return FramePose(block.transforms[frame - first], block.local_transforms[frame - first], block.betas)


def _prepared(outfit: Outfit, hidden: NDArray[np.bool_] | None) -> list[PosedLayer]:
    """Every layer prepared for the wearer's shape."""
    betas, shown = torch.from_numpy(outfit.betas), None if hidden is None else ~hidden
    return [
        PosedLayer(layer.model, betas, outfit.replacements, shown)
        if layer.name == BODY
        else PosedLayer(layer.model, betas, residual=outfit.driver(layer).residual)
        for layer in outfit.layers
    ]


def _buffers(names: tuple[str, ...], counts: list[int]) -> tuple[Gaussians, list[PosedBuffers]]:
    """Memory for all Gaussians, and each layer's part of it; counts: Gaussians by layer."""
    total = sum(counts)
    means, opacities = np.zeros((total, 3), np.float32), np.zeros(total, np.float32)
    covariances = np.zeros((total, 3, 3), np.float32)
    features = np.zeros((total, 3 + len(names)), np.float32)
    ids = np.repeat(np.arange(len(names)), counts)
    features[np.arange(total), 3 + ids] = 1.0
    arrays = [torch.from_numpy(array) for array in (means, covariances, opacities, features, ids)]
    gaussians = Gaussians(arrays[0], arrays[1], arrays[2], arrays[3], arrays[4], names)
    parts = [slice(first, first + n) for first, n in zip(np.cumsum([0, *counts[:-1]]), counts, strict=True)]
    return gaussians, [PosedBuffers(means[p], covariances[p], opacities[p], features[p, :3]) for p in parts]


def _same(before: tuple[Tensor, ...] | None, now: tuple[Tensor, ...]) -> bool:
    return (
        before is not None
        and len(before) == len(now)
        and all(torch.equal(one, other) for one, other in zip(before, now, strict=True))
    )
