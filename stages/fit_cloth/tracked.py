"""Where a garment was seen in the take, and where bones and learned offsets put it in a part left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.avatar.deform import blended, moved, shaped_positions
from stages.shared.avatar.pose import FramePose, frame_pose, recent_motion
from stages.shared.body import BodyModel, Poses
from stages.shared.metrics.vertex_error import spanned_triangles
from stages.shared.outfit.layer import WornLayer

Floats = NDArray[np.float32]

_NO_POSE = 1e9  # a description that no pose resembles


@dataclass(frozen=True, eq=False)
class TrackedGarment:
    """A garment's texels in the frames of a take, as training tracked them.

    Attributes:
        layer: the garment. poses: T frames. offsets: (T, N, 3) f32 m canonical, tracked.
        observed: (K,) some of the texels that cameras see. triangles: (M, 3) between those of all of them.
        part_of: (T,) the part of the take that each frame belongs to.
    """

    layer: WornLayer
    body: BodyModel
    poses: Poses
    offsets: Floats
    observed: NDArray[np.int64]
    triangles: NDArray[np.int32]
    part_of: NDArray[np.int64]

    def pose(self, row: int) -> FramePose:
        """Bones of a frame."""
        return _frame(self.body, self.poses, row)

    def world(self, row: int, offsets: Floats) -> Floats:
        """(N, 3) m, world, of texels with these canonical offsets (N, 3)."""
        pose, maps = self.pose(row), self.layer.maps
        points = shaped_positions(maps, pose.betas) + torch.from_numpy(offsets)
        return moved(points, blended(maps.skin_weights, pose.transforms)).numpy()

    def positions(self, row: int) -> Floats:
        """(N, 3) m, world, where the texels were seen."""
        return self.world(row, self.offsets[row])

    def distance(self, row: int, places: NDArray) -> float:
        """Mean distance in metres between (N, 3) and where the observed texels were seen."""
        apart = places[self.observed] - self.positions(row)[self.observed]
        return float(np.linalg.norm(apart, axis=1).mean())


@torch.no_grad()
def tracked_garment(
    layer: WornLayer, body: BodyModel, poses: Poses, parts: int, most_texels: int = 4000
) -> TrackedGarment:
    """Ask a trained garment where it is in every frame of its own take."""
    offsets = np.stack([_offsets(layer, body, poses, row) for row in range(len(poses))])
    observed = _observed(layer)
    step = max(1, len(observed) // most_texels)
    part_of = np.arange(len(poses)) * min(parts, len(poses)) // len(poses)
    return TrackedGarment(
        layer, body, poses, offsets, observed[::step].numpy(), _triangles(layer, observed), part_of
    )


def _triangles(layer: WornLayer, observed: Tensor) -> NDArray[np.int32]:
    """(M, 3) triangles between neighbouring texels among the observed ones (K,)."""
    seen = np.zeros(len(layer.maps), dtype=bool)
    seen[observed.numpy()] = True
    triangles = spanned_triangles(layer.maps.neighbours.numpy())
    return triangles[seen[triangles].all(axis=1)]


def bones_places(tracked: TrackedGarment) -> list[Floats]:
    """(N, 3) m per frame: bones with the mean offset of the other parts, shrunk as the training chose."""
    means = _means_of_others(tracked)
    return [tracked.world(row, means[part]) for row, part in enumerate(tracked.part_of)]


@torch.no_grad()
def learned_places(tracked: TrackedGarment) -> list[Floats] | None:
    """(N, 3) m per frame: what the decoder says when the key poses of the frame's part are left out.

    None for a decoder without key poses: nothing can be left out of it afterwards.
    """
    model = tracked.layer.model
    key_poses = model.key_poses
    if key_poses is None:
        return None
    described = _descriptions(tracked)
    nearest = torch.cdist(key_poses.poses, described).argmin(dim=1).numpy()
    kept, means = key_poses.poses.clone(), _means_of_others(tracked)
    fallback = model.mean_residual_of_training()
    kept_mean = fallback.clone()
    places: list[Floats] = [np.zeros((0, 3), np.float32)] * len(tracked.poses)
    try:
        for part in np.unique(tracked.part_of):
            key_poses.poses[torch.from_numpy(tracked.part_of[nearest] == part)] = _NO_POSE
            scale = model.model_config.offset_scale
            fallback[:, :3] = (torch.from_numpy(means[part]) - model.base_offset) / scale
            for row in np.flatnonzero(tracked.part_of == part):
                offsets = _offsets(tracked.layer, tracked.body, tracked.poses, int(row))
                places[row] = tracked.world(int(row), offsets)
            key_poses.poses.copy_(kept)
    finally:
        key_poses.poses.copy_(kept)
        fallback.copy_(kept_mean)
    return places


def _means_of_others(tracked: TrackedGarment) -> dict[int, Floats]:
    """For every part the mean offsets (N, 3) of the other parts, shrunk by the training's own share."""
    layer, offsets = tracked.layer, tracked.offsets
    model = layer.model
    whole = offsets.mean(axis=0)
    constant = model.attributes(model.mean_residual_of_training()).offsets.detach().numpy()
    share = float((constant * whole).sum() / max(float((whole * whole).sum()), 1e-12))
    share = min(max(share, 0.0), 1.0)
    means = {}
    for part in np.unique(tracked.part_of):
        others = tracked.part_of != part
        mean = offsets[others].mean(axis=0) if others.any() else whole
        means[int(part)] = (share * mean).astype(np.float32)
    return means


def _descriptions(tracked: TrackedGarment) -> Tensor:
    """(T, M) how the decoder describes the pose of every frame to its key poses."""
    key_poses = tracked.layer.model.key_poses
    assert key_poses is not None
    seen: list[Tensor] = []
    hook = key_poses.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0].clone()))
    try:
        for row in range(len(tracked.poses)):
            _offsets(tracked.layer, tracked.body, tracked.poses, row)
    finally:
        hook.remove()
    return torch.stack(seen)


def _offsets(layer: WornLayer, body: BodyModel, poses: Poses, row: int) -> Floats:
    """(N, 3) m canonical: what the decoder says in a frame."""
    history = layer.model.model_config.history
    motion = recent_motion(poses, row, history) if history else None
    residual = layer.model.residual(_frame(body, poses, row).local_transforms, motion=motion)
    return layer.model.attributes(residual).offsets.detach().numpy()


def _frame(body: BodyModel, poses: Poses, row: int) -> FramePose:
    arrays = (poses.rotations[row], poses.translation[row], poses.betas)
    return frame_pose(body, *(torch.from_numpy(array) for array in arrays))


def _observed(layer: WornLayer) -> Tensor:
    """Indices of the texels that cameras see; of all where none is."""
    observed = torch.nonzero(layer.model.observed > 0).flatten()
    return observed if len(observed) else torch.arange(len(layer.maps))
