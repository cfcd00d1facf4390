"""Fits blendshapes to a network: principal components of its answers, and a kernel from pose to their scores.

The network is asked about the poses that it was trained in, and about some in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from stages.distill.config import DistillConfig
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.blendshapes import (
    BlendshapeDecoder,
    BlendshapeSizes,
    gaussian_kernel,
    neighbour_distance,
)
from stages.shared.avatar.decoders.texel_attributes import BASIS_GROUPS, group_channels
from stages.shared.avatar.pose import frame_pose, recent_motion
from stages.shared.body import BodyModel, Poses

_WIDTHS = (1.0, 2.0, 4.0, 8.0)  # tried kernel widths, in typical distances between neighbouring poses
_RIDGES = (1e-6, 1e-4, 1e-2)
_FOLDS = 5


@dataclass(frozen=True)
class Samples:
    """Moments to ask a network about.

    Attributes:
        poses: (55, 4, 4) bone transforms without shape and root, of each.
        moments: the motion that each belongs to, and its row there.
        training: how many of them, the first, are training poses.
    """

    poses: list[Tensor]
    moments: list[tuple[Poses, int]]
    training: int

    def motions(self, integrators: int) -> list[Tensor] | None:
        """(H,) recent motion of each, with this many leaky integrators; None for no integrators."""
        if not integrators:
            return None
        return [recent_motion(motion, row, integrators) for motion, row in self.moments]


def sample_poses(body: BodyModel, training: Poses, extra: Sequence[Poses], config: DistillConfig) -> Samples:
    """The training poses, evenly spread; then blends of random pairs of them; then other motions.

    A blend has the recent motion of the nearer of its two.
    """
    chosen = _evenly(training, config.training_poses)
    rotations = [torch.from_numpy(training.rotations[row]) for row in chosen]
    moments: list[tuple[Poses, int]] = [(training, row) for row in chosen]
    draw = np.random.default_rng(config.seed)
    if len(chosen) > 1:
        for _ in range(config.blended_poses):
            one, other = draw.choice(len(chosen), size=2, replace=False)
            share = float(draw.uniform(0.0, 0.75))
            rotations.append(blend_rotations(rotations[one], rotations[other], share))
            moments.append((training, chosen[one if share < 0.5 else other]))
    for motion in extra:
        for row in _evenly(motion, config.extra_poses):
            rotations.append(torch.from_numpy(motion.rotations[row]))
            moments.append((motion, row))
    return Samples([_local(body, rotation) for rotation in rotations], moments, len(chosen))


def blend_rotations(one: Tensor, other: Tensor, share: float) -> Tensor:
    """(55, 3) axis-angle `share` of the way from `one` to `other` along each joint's shortest arc."""
    import roma  # loads the whole of torch._dynamo: two seconds

    start, end = roma.rotvec_to_unitquat(one), roma.rotvec_to_unitquat(other)
    steps = torch.tensor([share], dtype=one.dtype)
    return roma.unitquat_to_rotvec(roma.unitquat_slerp(start, end, steps, shortest_arc=True)[0])


def _evenly(motion: Poses, count: int) -> list[int]:
    return sorted({round(row) for row in np.linspace(0, len(motion) - 1, min(count, len(motion)))})


def _local(body: BodyModel, rotations: Tensor) -> Tensor:
    return frame_pose(body, rotations, torch.zeros(3), torch.zeros(10)).local_transforms


@dataclass(frozen=True)
class Components:
    """Principal components of one group of channels.

    Attributes:
        bases: (N, C, K). scores: (T, K) of the sampled poses. left_out: RMS of what K components leave out,
            in the group's unit. energy: share of the variance that they keep.
    """

    bases: Tensor
    scores: Tensor
    left_out: float
    energy: float


@dataclass(frozen=True)
class Fit:
    """A distilled layer and how well it answers poses that its kernel was not given (RMS, by group)."""

    model: BlendshapeDecoder
    components: dict[str, Components]
    unseen_error: dict[str, float]


def components(values: Tensor, unit: float, tolerance: float, most: int) -> Components:
    """Components of centred answers (T, N, C): as few as leave out less than `tolerance`, one at least.

    `unit` converts a value to what the tolerance is said in. Through the (T, T) Gram matrix, in float64.
    """
    count = values.shape[0]
    flat = values.reshape(count, -1)
    gram = torch.zeros(count, count, dtype=torch.float64)
    for part in flat.split(1 << 16, dim=1):  # float64 copies of a part at a time
        gram += part.double() @ part.double().T
    spread, axes = torch.linalg.eigh(gram)
    spread, axes = spread.flip(0).clamp(min=0.0), axes.flip(1)
    rest = (spread.sum() - spread.cumsum(0)).clamp(min=0.0)
    left_out = unit * (rest / (count * values.shape[1])).sqrt()
    kept = int((left_out > tolerance).sum()) + 1
    kept = max(1, min(kept, most, count))
    scale = spread[:kept].sqrt()
    inverse = torch.where(scale > 1e-9 * scale[0].clamp(min=1e-30), 1.0 / scale, 0.0)
    bases = (axes[:, :kept] * inverse).T.float() @ flat
    total = float(spread.sum())
    return Components(
        bases.reshape(kept, *values.shape[1:]).permute(1, 2, 0).contiguous(),
        (axes[:, :kept] * scale).float(),
        float(left_out[kept - 1]),
        1.0 - float(rest[kept - 1]) / total if total > 0 else 1.0,
    )


def fit_layer(teacher: Decoder, residuals: Tensor, samples: Samples, config: DistillConfig) -> Fit:
    """The blendshapes of a layer.

    Arguments:
        teacher: the trained model; its free attributes are taken over.
        residuals: (T, N, 14) its answers to the samples.
    """
    mean = residuals[: samples.training].mean(dim=0)
    centred = residuals - mean
    units = {"offset": teacher.model_config.offset_scale, "color": 1.0, "form": 1.0}
    tolerances = (config.offset_tolerance, config.color_tolerance, config.form_tolerance)
    parts = {
        group: components(centred[:, :, group_channels(group)], units[group], tolerance, most)
        for group, tolerance, most in zip(BASIS_GROUPS, tolerances, config.most, strict=True)
    }
    scores = torch.cat([part.scores for part in parts.values()], dim=1).double()
    counts = {group: part.scores.shape[1] for group, part in parts.items()}
    ranks = (counts["offset"], counts["color"], counts["form"])
    model_config = replace(teacher.model_config, decoder="blendshapes", ranks=ranks, anchors=0)
    model = BlendshapeDecoder(
        teacher.maps, model_config, BlendshapeSizes(**counts, centres=len(samples.poses))
    )
    motions = samples.motions(model_config.history)
    described = model.fit_description(samples.poses, motions).double()
    width, ridge, unseen = _chosen_kernel(described, scores)
    with torch.no_grad():
        for name, tensor in teacher.state().items():
            if name.startswith("base_"):
                getattr(model, name).copy_(tensor)
        model.set_observed(teacher.observed)
        model.mean_residual.copy_(mean)
        model.coefficients.centres.copy_(described)
        model.coefficients.bandwidth.copy_(width)
        model.coefficients.weights.copy_(_solve(gaussian_kernel(described, described, width), scores, ridge))
        for group, part in parts.items():
            getattr(model, f"basis_{group}").copy_(part.bases)
    first, errors = 0, {}
    for group, count in counts.items():
        wrong = unseen[:, first : first + count].square().sum(dim=1)
        errors[group] = units[group] * float((wrong.mean() / len(teacher.maps)).sqrt())
        first += count
    return Fit(model, parts, errors)


def _chosen_kernel(described: Tensor, scores: Tensor) -> tuple[Tensor, float, Tensor]:
    """Width and ridge that predict left-out poses best, and the errors (T, K) of those predictions.

    Bases are orthonormal, so errors of scores are errors of the attributes.
    """
    typical = neighbour_distance(described).clamp(min=1e-6)
    shuffled = torch.randperm(len(described), generator=torch.Generator().manual_seed(0))
    fold = shuffled % _FOLDS  # neighbours in time would otherwise help each other in a pattern
    best: tuple[float, Tensor, float, Tensor] | None = None
    for width in _WIDTHS:
        kernel = gaussian_kernel(described, described, typical * width)
        for ridge in _RIDGES:
            errors = scores.clone()
            for left_out in range(min(_FOLDS, len(described))):
                known, asked = fold != left_out, fold == left_out
                if known.any():
                    weights = _solve(kernel[known][:, known], scores[known], ridge)
                    errors[asked] = kernel[asked][:, known] @ weights - scores[asked]
            total = float(errors.square().sum())
            if best is None or total < best[0]:
                best = (total, typical * width, ridge, errors)
    assert best is not None
    return best[1], best[2], best[3]


def _solve(kernel: Tensor, scores: Tensor, ridge: float) -> Tensor:
    """Kernel ridge regression: (K + λ I)⁻¹ scores."""
    return torch.linalg.solve(kernel + ridge * torch.eye(len(kernel), dtype=kernel.dtype), scores)
