"""Track garments through the take: the geometry is right before the texture is learned.

First the texels learn the appearance of the template's own frame (`warm_up.py`), where the geometry is
right. Then garments are tracked from frame to frame. Each frame takes a few Gauss-Newton steps: render, dense
flow to the pictures of all cameras, and one sparse linear system for the offsets of the frame's key pose.
Cloth moves by a few pixels between frames, but by centimetres between poses, so that stripes are not confused
with their neighbours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from stages.shared.avatar.compose import compose
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.key_poses import KeyPoseOffsets
from stages.shared.avatar.deform import PosedGaussians, blended, pose_layer
from stages.shared.avatar.pose import FramePose
from stages.shared.layers import BODY
from stages.shared.splat.gaussians import Gaussians
from stages.train.config import TrackConfig
from stages.train.objective import render
from stages.train.tracking.control_grid import ControlGrid, Floats, conjugate_gradient, fit_control_points
from stages.train.tracking.normal_equations import (
    NormalEquations,
    collision_equations,
    estimate_flow,
    grey_picture,
)
from stages.train.views import TrainingViews, View
from stages.train.warm_start import PretrainedLayers

_PER_METRE = 220.0  # px; only the unit of the solution, which the smoothness weights refer to
_SOLVER_STEPS = 60
_REFERENCE_SHARE = 0.9  # share of the last frame's shape that smoothness takes as its reference
_BODY_JOINTS = 22  # without face and fingers
_EXTRAPOLATION = 0.5  # share of the last frame's motion that is expected to continue
Checkpoint = Callable[[], None]
"""Called between small units of work; may raise `Interrupted`."""


class Interrupted(Exception):
    """Tracking of a frame, or the warm-up, was stopped on request. Nothing of the unfinished unit remains."""


@dataclass(frozen=True)
class _TrackedLayer:
    """One layer that is tracked."""

    decoder: Decoder
    key_poses: KeyPoseOffsets
    grid: ControlGrid
    size: tuple[int, int]  # of the coarse maps that the control grid belongs to
    control_points: Tensor  # (K, M, 3) m, the solution of every key pose's frame


class Tracker:
    """Fits the key poses of garments, frame by frame.

    Arguments:
        models: name to decoder, inner to outer; those with key poses are tracked, one key pose per frame of
            `frames` in order. views: training pictures. frames: numbers. start: index into `frames` where the
            geometry is right. poses: frame number to pose.
        pretrained: layers that start from another training; None where all are new.
    """

    def __init__(
        self,
        config: TrackConfig,
        models: dict[str, Decoder],
        views: TrainingViews,
        frames: list[int],
        start: int,
        poses: Any,
        pretrained: PretrainedLayers | None = None,
    ) -> None:
        self.config, self.models, self.views, self.frames, self.poses = config, models, views, frames, poses
        self.start = start
        self.route = plan_route(views.sequence.groups(frames), start, self._descriptions())
        self.order = self.route.order
        self.tracked = {
            name: _tracked_layer(model, model.key_poses, config.cell)
            for name, model in models.items()
            if model.key_poses is not None
        }
        self.pretrained = pretrained
        initial = pretrained.offsets(frames[start]) if pretrained else {}
        self.initial = {
            n: fit_control_points(self.tracked[n].grid, offsets) for n, offsets in initial.items()
        }

    @property
    def units_per_frame(self) -> int:
        """How often `follow` calls its checkpoint."""
        return (1 + self.config.rounds) * len(self.views.sequence.training_cameras)

    @torch.no_grad()
    def follow(self, place: int, checkpoint: Checkpoint = lambda: None) -> None:
        """Fit the offsets of the frame at `place` of `order`; those before it must be done.

        Raises:
            Interrupted: by `checkpoint`; the frame is then left as it was.
        """
        index = self.order[place]
        frame = self.frames[index]
        last, earlier = self.route.before[index], self.route.earlier(index)
        reference = {
            name: self._initial(name, layer) if last is None else _control_points(layer, last)
            for name, layer in self.tracked.items()
        }
        points = dict(reference)
        if earlier is not None:
            for name, layer in self.tracked.items():
                before = _control_points(layer, earlier)
                points[name] = reference[name] + _EXTRAPOLATION * (reference[name] - before)
        pose = self.poses(frame)
        views = []
        for camera in self.views.sequence.training_cameras:
            checkpoint()
            views.append(self.views.view(frame, camera, self.config.scale or 1.0))
        rounds, residuals = self.config.rounds, self.pretrained.residuals(frame) if self.pretrained else {}
        for number in range(rounds):
            equations = self._equations(pose, views, points, residuals, number == rounds - 1, checkpoint)
            points = {
                name: points[name] + self._step(layer.grid, equations[name], points[name], reference[name])
                for name, layer in self.tracked.items()
            }
        for name, layer in self.tracked.items():
            self._store(layer, index, points[name])

    @torch.no_grad()
    def carry(self, place: int) -> None:
        """Give the frame at `place` of `order` the offsets of the frame that it is reached from."""
        index = self.order[place]
        last = self.route.before[index]
        for name, layer in self.tracked.items():
            points = self._initial(name, layer) if last is None else _control_points(layer, last)
            self._store(layer, index, points)

    def _descriptions(self) -> Tensor:
        """(K, 198) rotations of the body's joints in every frame, for distances between poses."""
        poses = [self.poses(frame).local_transforms[:_BODY_JOINTS, :3, :3].flatten() for frame in self.frames]
        return torch.stack(poses).cpu()

    def _initial(self, name: str, layer: _TrackedLayer) -> Floats:
        """Control points (M, 3) m of the first frame: zero, or those of a pretrained layer."""
        return self.initial.get(name, np.zeros((len(layer.grid.where), 3)))

    def _equations(
        self,
        pose: FramePose,
        views: list[View],
        points: dict[str, Floats],
        residuals: dict[str, Tensor],
        fine: bool,
        checkpoint: Checkpoint,
    ) -> dict[str, NormalEquations]:
        """Normal equations of every tracked layer from all cameras and from collisions."""
        posed, composite, slices = self._composite(pose, points, residuals)
        jacobians = {
            name: blended(layer.decoder.maps.skin_weights, pose.transforms)[:, :, :3].double().cpu().numpy()
            for name, layer in self.tracked.items()
        }
        equations = {
            name: NormalEquations.zero(len(layer.decoder.maps)) for name, layer in self.tracked.items()
        }
        means = composite.means.double().cpu().numpy()
        for view in views:
            checkpoint()
            picture = render(composite, view.camera)
            rendered, pictured = (picture.labels, view.labels) if self.config.labels else (None, None)
            truth = grey_picture(view.image * view.inside[..., None], pictured)
            flow = estimate_flow(grey_picture(picture.color, rendered), truth, fine)
            if flow is None:
                continue
            depth = picture.expected_depth.detach().double().cpu().numpy()
            for name in self.tracked:
                channel = composite.layers.index(name)
                equations[name].add(
                    means[slices[name]],
                    jacobians[name],
                    view.camera,
                    depth,
                    picture.labels[..., channel].cpu().numpy() > 0.5,
                    (view.inside if pictured is None else pictured[..., channel]).numpy() > 0.5,
                    flow,
                    _PER_METRE,
                )
        for name, layer in self.tracked.items():
            if not layer.decoder.all_observed:
                equations[name].scale(layer.decoder.observed.double().cpu().numpy())
            if self.config.collision and BODY in posed:
                matrix, right = collision_equations(
                    posed[name].means, posed[BODY], jacobians[name], _PER_METRE
                )
                equations[name].matrix[:] += self.config.collision * matrix
                equations[name].right[:] += self.config.collision * right
        return equations

    def _composite(
        self, pose: FramePose, points: dict[str, Floats], residuals: dict[str, Tensor]
    ) -> tuple[dict[str, PosedGaussians], Gaussians, dict[str, slice]]:
        """All layers in a pose with these control points: by name, together, and each layer's rows."""
        posed, slices, first = {}, {}, 0
        for name, model in self.models.items():
            nothing = model.base_color.new_zeros(len(model.maps), 14)
            attributes = model.attributes(residuals.get(name, nothing))
            if name in points:
                offsets = torch.from_numpy(self.tracked[name].grid.basis @ points[name])
                attributes = replace(attributes, offsets=attributes.offsets + offsets.to(attributes.offsets))
            posed[name] = pose_layer(model.maps, attributes, pose.transforms, pose.betas)
            slices[name] = slice(first, first + len(model.maps))
            first += len(model.maps)
        return posed, compose(posed), slices

    def _step(
        self, grid: ControlGrid, equations: NormalEquations, points: Floats, reference: Floats
    ) -> Floats:
        """Change of the control points (M, 3) m: data and smoothness; unseen ones stay near `reference`."""
        config = self.config
        apply = partial(_apply_system, config, grid, equations)
        right = grid.basis.T @ equations.right - config.inertia * ((points - reference) * _PER_METRE)
        right -= _smoothness(config, grid, points * _PER_METRE - _REFERENCE_SHARE * reference * _PER_METRE)
        return conjugate_gradient(apply, right, _SOLVER_STEPS) / _PER_METRE

    def _store(self, layer: _TrackedLayer, index: int, points: Floats) -> None:
        """Keep control points (M, 3), and write them into the key pose's finer maps (2·3, h, w)."""
        layer.control_points[index] = torch.from_numpy(points).to(layer.control_points)
        offsets = layer.key_poses.offsets.data[index]
        coarse = torch.zeros(4, 2 * layer.size[0] * layer.size[1])
        coarse[:3, layer.grid.where] = layer.control_points[index].T
        coarse[3, layer.grid.where] = 1.0
        coarse = coarse.view(4, 2, *layer.size).transpose(0, 1)
        fine = functional.interpolate(coarse, offsets.shape[1:], mode="bilinear", align_corners=False)
        covered = fine[:, 3:] > 1e-3  # cells that no texel follows do not pull at their neighbours
        values = torch.where(covered, fine[:, :3] / fine[:, 3:].clamp(min=1e-3), 0.0)
        offsets.copy_(values.reshape(offsets.shape))


def _apply_system(
    config: TrackConfig, grid: ControlGrid, equations: NormalEquations, change: Floats
) -> Floats:
    """The matrix of data, smoothness and inertia times a change of control points (M, 3)."""
    data = np.einsum("nab,nb->na", equations.matrix, grid.basis @ change)
    return np.asarray(grid.basis.T @ data + _smoothness(config, grid, change) + config.inertia * change)


def _smoothness(config: TrackConfig, grid: ControlGrid, values: Floats) -> Floats:
    """The smoothness matrix times control points (M, 3)."""
    return np.asarray(config.bending * (grid.bending @ values) + config.stretch * (grid.stretch @ values))


def _tracked_layer(decoder: Decoder, key_poses: KeyPoseOffsets, cell: int) -> _TrackedLayer:
    height, width = key_poses.offsets.shape[2:]
    ratio = max(1, round(cell / key_poses.cell))
    if height % ratio or width % ratio:
        ratio = 1
    size = (height // ratio, width // ratio)
    grid = ControlGrid.of(decoder.maps, key_poses.points, size)
    points = torch.zeros(len(key_poses.offsets), len(grid.where), 3)
    return _TrackedLayer(decoder, key_poses, grid, size, points)


def _control_points(layer: _TrackedLayer, index: int) -> Floats:
    """Control points (M, 3) m of a key pose."""
    return np.asarray(layer.control_points[index].double().numpy())


@dataclass(frozen=True)
class Route:
    """An order of frames.

    Attributes:
        order: indices of frames. before: the frame from which each frame is reached; None for the first.
        entries: the first frame of every take.
    """

    order: list[int]
    before: dict[int, int | None]
    entries: frozenset[int]

    def earlier(self, index: int) -> int | None:
        """The frame before the one that a frame is reached from, where all three are neighbours in a take."""
        last = self.before[index]
        if last is None or self.entries & {index, last}:
            return None
        return self.before[last]


def plan_route(groups: list[list[int]], start: int, descriptions: Tensor) -> Route:
    """From `start` to the end of its take, then back to the beginning of the take; then the other takes.

    Another take is entered at the frame whose pose is nearest to a frame that has been tracked.

    Arguments:
        groups: indices of frames by take. descriptions: (K, M) poses of all frames.
    """
    order: list[int] = []
    before: dict[int, int | None] = {}
    entries = []
    for group in sorted(groups, key=lambda group: start not in group):
        entry, source = start, None
        if order:
            distance = torch.cdist(descriptions[group], descriptions[order])
            row, column = divmod(int(distance.argmin()), len(order))
            entry, source = group[row], order[column]
        forwards, backwards = [i for i in group if i > entry], [i for i in reversed(group) if i < entry]
        before |= {entry: source} | {i: i - 1 for i in forwards} | {i: i + 1 for i in backwards}
        order += [entry, *forwards, *backwards]
        entries.append(entry)
    return Route(order, before, frozenset(entries))
