"""Posing without gradients, in one pass: what `Decoder.attributes` and `pose_layer` do, fused.

For playing, not for training: activations, re-shaping, swap, skinning and covariances of a texel happen in
registers, bones with no weight are skipped, and results go into buffers that the caller owns. Normals are not
estimated. `pose_layer` is the plain version; the test is their difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.avatar.decoders.base import Decoder, LinearResidual
from stages.shared.avatar.decoders.texel_attributes import (
    BASIS_GROUPS,
    CHANNELS,
    MIN_SCALE,
    group_channels,
)
from stages.shared.avatar.deform import Replacement, shaped_positions
from stages.shared.avatar.pose import FramePose
from stages.shared.avatar.posing_kernel import BLOCK, carry_texels, pose_texels
from stages.shared.splat.kernels.threads import run_parallel

LEAST_WEIGHT = 1e-6  # a bone with less moves a texel by less than a thousandth of a millimetre

_CHANNELS = np.array([channel for group in BASIS_GROUPS for channel in group_channels(group)])

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
Skinning = tuple[Ints, Ints, Floats, Floats]
"""Where each texel's bones start (N + 1,), the bones, their weights, and the bones' matrices (·, 3, 4)."""


@dataclass(frozen=True, eq=False)
class PosedBuffers:
    """Where a layer's posed Gaussians are written; views into the arrays of a whole outfit.

    Attributes:
        means: (N, 3) m, world. covariances: (N, 3, 3) m². opacities: (N,). colors: (N, 3) sRGB.
        painted: not empty once opacities and colours are there that no pose changes.
    """

    means: Floats
    covariances: Floats
    opacities: Floats
    colors: Floats
    painted: list[bool] = field(default_factory=list)


class PosedLayer:
    """A layer prepared for one body shape.

    Arguments:
        model: of the layer. betas: (10,) shape of the wearer.
        replacements: applied in this order.
        kept: (N,) texels that are posed, None for all; buffers then hold these alone, in order.
        residual: (N, 14) in place of the model's own in all poses; None for the model's.
    """

    def __init__(
        self,
        model: Decoder,
        betas: Tensor,
        replacements: tuple[Replacement, ...] = (),
        kept: NDArray[np.bool_] | None = None,
        residual: Tensor | None = None,
    ) -> None:
        config, self.model = model.model_config, model
        rows = None if kept is None else torch.from_numpy(np.flatnonzero(kept))
        self.count = len(model.maps) if rows is None else len(rows)
        self._rows, self.history = rows, config.history if residual is None else 0
        linear = model.linear_residual() if residual is None else LinearResidual(residual)
        self._linear = linear
        self.bases = _blocks(linear, self.count, rows)
        self._mean_residual = None if linear is None else _chosen(linear.mean, rows)
        self.rest = _chosen(shaped_positions(model.maps, betas), rows).numpy()
        base = torch.cat(
            [getattr(model, f"base_{name}").detach().reshape(len(model.maps), -1) for name in CHANNELS], 1
        )
        self.base = _chosen(base, rows).contiguous().numpy()
        self.bones = _sparse(_chosen(model.maps.skin_weights, rows).numpy())
        self._followed = torch.from_numpy(np.unique(self.bones[1]).astype(np.int64))
        # With a matrix per texel, every texel follows a bone of its own.
        each = np.arange(self.count + 1, dtype=np.int32)
        self._texels = (each, each[:-1], np.ones(self.count, np.float32))
        self.limits = np.array(
            [
                config.offset_scale,
                math.log(MIN_SCALE) if config.max_scale > 0 else -np.inf,
                math.log(config.max_scale) if config.max_scale > 0 else np.inf,
            ],
            np.float32,
        )
        self.bounded = config.color == "sigmoid"
        # No pose changes colours, opacities and form of a layer whose residual is constant: kept once known.
        self.constant = linear is not None and not any(len(b) and b.shape[1] for b in self.bases)
        self._canonical: tuple[Floats, Floats, Floats] | None = None
        self._looks: tuple[Floats, Floats] | None = None
        self.replacements = _stacked(replacements, len(model.maps), kept)

    def pose(
        self,
        pose: FramePose,
        out: PosedBuffers,
        motion: Tensor | None = None,
        texel_matrices: Tensor | None = None,
    ) -> None:
        """Pose the layer.

        Arguments:
            pose: of the frame; its betas are not used. out: overwritten.
            motion: `recent_motion`, None for a still pose or a model without history.
            texel_matrices: (N, 3, 4) posed_from_canonical of every texel, in place of the pose's bones.
        """
        if texel_matrices is None:
            matrices = pose.transforms.numpy()[:, :3, :]
            skinning = (*self.bones, np.ascontiguousarray(matrices, dtype=np.float32))
        else:
            matrices = _chosen(texel_matrices, self._rows).numpy()
            skinning = (*self._texels, np.ascontiguousarray(matrices, dtype=np.float32))
        if self.constant:
            self._carry(skinning, out)
        else:
            self._pose_all(pose, skinning, out, motion, *(np.zeros((0, k), np.float32) for k in (3, 4, 3)))

    def depends_on(
        self, pose: FramePose, motion: Tensor | None, texel_matrices: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """What a pose of this layer is computed from: the same numbers give the same Gaussians."""
        if self.constant:
            return (pose.transforms[self._followed] if texel_matrices is None else texel_matrices,)
        matrices = pose.transforms if texel_matrices is None else texel_matrices
        return (matrices, pose.local_transforms, *(() if motion is None else (motion,)))

    def _carry(self, skinning: Skinning, out: PosedBuffers) -> None:
        if self._canonical is None:  # two threads may both find it: the same numbers
            kept = tuple(np.empty((self.count, k), np.float32) for k in (3, 4, 3))
            looks = PosedBuffers(
                np.empty_like(out.means), np.empty_like(out.covariances),
                np.empty(self.count, np.float32), np.empty((self.count, 3), np.float32),
            )  # fmt: skip
            self._pose_all(None, skinning, looks, None, *kept)
            self._looks, self._canonical = (looks.opacities, looks.colors), kept  # type: ignore[assignment]
        assert self._canonical is not None and self._looks is not None
        if not out.painted:
            out.opacities[:], out.colors[:] = self._looks
            out.painted.append(True)
        run_parallel(
            carry_texels, *self._canonical, *skinning, out.means, out.covariances,
        )  # fmt: skip

    def _pose_all(
        self,
        pose: FramePose | None,
        skinning: Skinning,
        out: PosedBuffers,
        motion: Tensor | None,
        *kept: Floats,
    ) -> None:
        """The whole of it; `pose` is not needed by a layer that no pose changes."""
        linear, residual, coefficients = self._linear, self._mean_residual, torch.zeros(0)
        if pose is not None and linear is not None and linear.coefficients is not None:
            coefficients = linear.coefficients(pose.local_transforms, motion)
        if residual is None:
            assert pose is not None
            whole = self.model.residual(pose.local_transforms, motion=motion)
            residual = _chosen(self.model.observed_residual(whole), self._rows)
        run_parallel(
            pose_texels, residual.numpy(), coefficients.numpy(), *self.bases, _CHANNELS,
            self.base, self.limits, self.bounded, self.rest,
            *skinning, *self.replacements,
            out.means, out.covariances, out.opacities, out.colors, *kept,
        )  # fmt: skip


def _chosen(values: Tensor, rows: Tensor | None) -> Tensor:
    return values if rows is None else values[rows]


def _blocks(linear: LinearResidual | None, count: int, rows: Tensor | None) -> tuple[Floats, ...]:
    """Bases of every group by blocks of texels (⌈N / BLOCK⌉, K, C, BLOCK): read in one run, in order."""
    blocks, arrays = -(-count // BLOCK), []
    for group in BASIS_GROUPS:
        if linear is None or linear.bases is None:
            arrays.append(np.zeros((blocks, 0, len(group_channels(group)), BLOCK), np.float32))
            continue
        basis = _chosen(linear.bases[group].detach(), rows).numpy()
        padded = np.zeros((blocks * BLOCK, *basis.shape[1:]), np.float32)
        padded[: len(basis)] = basis
        by_block = padded.reshape(blocks, BLOCK, *basis.shape[1:])
        arrays.append(np.ascontiguousarray(by_block.transpose(0, 3, 2, 1)))
    return tuple(arrays)


def _sparse(weights: Floats) -> tuple[NDArray[np.int32], NDArray[np.int32], Floats]:
    """Rows (N, 55) without their zeros: where each row starts (N + 1,), its bones, their weights."""
    kept = weights > LEAST_WEIGHT
    first = np.concatenate([[0], np.cumsum(kept.sum(axis=1))]).astype(np.int32)
    rows, bones = np.nonzero(kept)
    values = weights[rows, bones]
    # What is left out is shared by the rest, so that rows still sum to what they did.
    totals = np.add.reduceat(values.astype(np.float64), first[:-1]) if len(values) else np.zeros(0)
    values = values * (weights.sum(axis=1, dtype=np.float64) / totals)[rows]
    return first, bones.astype(np.int32), values.astype(np.float32)


def _stacked(
    replacements: tuple[Replacement, ...], count: int, kept: NDArray[np.bool_] | None
) -> tuple[NDArray[Any], ...]:
    """Weights (R, N), offsets (R, N, 3), quaternions (R, N, 4), looks (R, N, 7), and who has the last."""
    weights, offsets, quaternions, looks = (
        np.zeros((len(replacements), count, *shape), np.float32) for shape in ((), (3,), (4,), (7,))
    )
    for row, replacement in enumerate(replacements):
        weights[row], offsets[row] = replacement.weights.numpy(), replacement.offsets.numpy()
        quaternions[row] = replacement.quaternions.numpy()
        if replacement.looks is not None:
            looks[row] = replacement.looks.numpy()
    paints = np.array([r.looks is not None for r in replacements], bool)
    if kept is not None:
        weights, offsets, quaternions, looks = (
            np.ascontiguousarray(values[:, kept]) for values in (weights, offsets, quaternions, looks)
        )
    return weights, offsets, quaternions, looks, paints
