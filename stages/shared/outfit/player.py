"""An outfit prepared for playing: frame after frame of Gaussians, into the same memory.

`Outfit.composite` is the plain version of the same thing, which allocates all it makes and estimates normals.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.avatar.compose import Composite
from stages.shared.avatar.motion import recent_motions
from stages.shared.avatar.pose import FramePose, pose_at
from stages.shared.avatar.posing import PosedBuffers, PosedLayer, Replacement
from stages.shared.body import Poses
from stages.shared.layers import BODY
from stages.shared.outfit.outfit import Outfit

_MOMENTS = 64  # bones of so many rows are posed together; one at a time costs as much as a layer


class Player:
    """Poses an outfit fast. What depends on the wearer's shape but not on the pose is computed once, here.

    Arguments:
        outfit: what is worn. twin: another player of it, to share what was prepared; buffers are each
            one's own, so that two threads can play two frames.
        hidden: (N,) texels of the body that are left out (`plan_hidden`); a twin's are its twin's.
        anew: pose every layer in every frame, also one that stands as it stood (for measuring).

    Attributes:
        posed_layers: how many layers were posed so far; layers that stand still are not.
    """

    def __init__(
        self,
        outfit: Outfit,
        twin: Player | None = None,
        hidden: NDArray[np.bool_] | None = None,
        anew: bool = False,
    ) -> None:
        self.outfit, self.anew, self.posed_layers = outfit, anew, 0
        # Push-out needs normals, and baselines bring labels of their own: these take the plain way.
        self.plain = bool(outfit.pushes) or any(layer.layer_ids is not None for layer in outfit.layers)
        self._bones: tuple[Poses, int, FramePose] | None = None
        self._motions: dict[int, Tensor] = {}  # of the same rows, by number of memories
        betas = torch.from_numpy(outfit.betas)
        changes = _changes(outfit)
        self._layers: list[PosedLayer] = (
            twin._layers
            if twin is not None
            else [
                PosedLayer(layer.model, betas, changes, None if hidden is None else ~hidden)
                if layer.name == BODY
                else PosedLayer(layer.model, betas, residual=outfit.driver(layer).residual)
                for layer in outfit.layers
            ]
        )
        counts = [posed.count for posed in self._layers]
        total, names = sum(counts), outfit.names
        means, opacities = np.zeros((total, 3), np.float32), np.zeros(total, np.float32)
        covariances = np.zeros((total, 3, 3), np.float32)
        features = np.zeros((total, 3 + len(names)), np.float32)
        ids = np.repeat(np.arange(len(names)), counts)
        features[np.arange(total), 3 + ids] = 1.0
        self._composite = Composite(
            means=torch.from_numpy(means),
            covariances=torch.from_numpy(covariances),
            opacities=torch.from_numpy(opacities),
            features=torch.from_numpy(features),
            layer_ids=torch.from_numpy(ids),
            layers=names,
        )
        self._standing: list[tuple[Tensor, ...] | None] = [None] * len(counts)  # what the buffers show
        self._parts = []
        for first, count in zip(np.cumsum([0, *counts[:-1]]), counts, strict=True):
            own = slice(first, first + count)
            self._parts.append(PosedBuffers(means[own], covariances[own], opacities[own], features[own, :3]))

    @torch.no_grad()
    def composite(self, poses: Poses, frame: int) -> Composite:
        """All Gaussians in the pose of a row of `poses`; overwritten by the next call."""
        if self.plain:
            return self.outfit.composite(poses, frame)
        pose = self._posed_bones(poses, frame)
        for place, (posed, out) in enumerate(zip(self._layers, self._parts, strict=True)):
            motion = self._motions[posed.history][frame % _MOMENTS] if posed.history else None
            matrices = self.outfit.driver(self.outfit.layers[place]).matrices(poses, frame)
            asked = posed.depends_on(pose, motion, matrices)
            if self.anew or not _same(self._standing[place], asked):
                self._standing[place] = None  # until the buffers are whole
                posed.pose(pose, out, motion, matrices)
                self._standing[place] = tuple(part.clone() for part in asked)
                self.posed_layers += 1
        return self._composite

    def _posed_bones(self, poses: Poses, frame: int) -> FramePose:
        """The bones of one row, from those of its block of rows; recent motion is found with them."""
        first = frame - frame % _MOMENTS
        if self._bones is None or self._bones[0] is not poses or self._bones[1] != first:
            rows = slice(first, first + _MOMENTS)
            moments = pose_at(self.outfit.body_model, poses, rows, self.outfit.betas)
            self._bones = (poses, first, moments)
            block_rows = range(first, min(first + _MOMENTS, len(poses)))
            histories = {posed.history for posed in self._layers if posed.history}
            self._motions = {history: recent_motions(poses, block_rows, history) for history in histories}
        block = self._bones[2]
        return FramePose(block.transforms[frame - first], block.local_transforms[frame - first], block.betas)


def _same(before: tuple[Tensor, ...] | None, now: tuple[Tensor, ...]) -> bool:
    return (
        before is not None
        and len(before) == len(now)
        and all(torch.equal(one, other) for one, other in zip(before, now, strict=True))
    )


def _changes(outfit: Outfit) -> tuple[Replacement, ...]:
    """What an outfit changes of the body's own: bare skin is restored, then garments bring their form."""
    changes = []
    if outfit.restoration is not None:
        skin = outfit.restoration
        looks = torch.cat((skin.colors, skin.scales, skin.opacities[:, None]), dim=1)
        changes.append(
            Replacement(
                skin.weights[:, 0].numpy(), skin.offsets.numpy(), skin.quaternions.numpy(), looks.numpy()
            )
        )
    for swap in outfit.swaps:
        changes.append(
            Replacement(swap.weights[:, 0].numpy(), swap.offsets.numpy(), swap.quaternions.numpy())
        )
    return tuple(changes)
