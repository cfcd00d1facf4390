"""Bring the geometry home before the texture is asked to match: follow the cloth through the take.

First the texels learn what the template's own frame looks like; there the geometry is right. Then the
garments are followed from frame to frame: render, dense flow to the pictures of all cameras, and one sparse
linear system for the offsets of the frame's anchor (Gauss-Newton), a few times per frame. Between frames
cloth moves by a few pixels where between poses it moves by centimetres, so that stripes are not mistaken for
their neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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
from stages.train.begin import Beginnings
from stages.train.cells import Cells
from stages.train.collision import outwards
from stages.train.config import TrackConfig
from stages.train.data import TrainingViews, View
from stages.train.displacement import Equations, grey_picture, motion
from stages.train.objective import render
from stages.train.solve import Floats, conjugate_gradients, fitted_cells

_PER_METRE = 220.0  # px; only the unit of the solution, which the smoothness weights refer to
_SOLVER_STEPS = 60
_KEPT = 0.9  # share of the last frame's shape that smoothness takes as rest
_BODY_JOINTS = 22  # without face and fingers
_FOLLOWING = 0.5  # share of the last frame's motion that is expected to go on


@dataclass(frozen=True)
class _Tracked:
    """One layer that is followed."""

    model: Decoder
    anchors: KeyPoseOffsets
    cells: Cells
    size: tuple[int, int]  # of the coarse maps that the cells belong to
    found: Tensor  # (K, M, 3) m, what was found of every anchor's frame


class Tracker:
    """Fills the anchors of garments, frame by frame.

    Arguments:
        models: name to model, inner to outer; those with anchors are followed, one anchor per frame of
            `frames` in order. views: training pictures. frames: numbers. start: index into `frames` where the
            geometry is right. poses: frame number to pose.
        begun: what layers bring that were learned before; None where all are new.
    """

    def __init__(
        self,
        config: TrackConfig,
        models: dict[str, Decoder],
        views: TrainingViews,
        frames: list[int],
        start: int,
        poses: Any,
        begun: Beginnings | None = None,
    ) -> None:
        self.config, self.models, self.views, self.frames, self.poses = config, models, views, frames, poses
        self.start = start
        self.route = route(views.footage.groups(frames), start, self._described())
        self.order = self.route.order
        self.tracked = {
            name: _tracked(model, model.key_poses, config.cell)
            for name, model in models.items()
            if model.key_poses is not None
        }
        self.begun = begun
        known = begun.offsets(frames[start]) if begun else {}
        self.beginning = {n: fitted_cells(self.tracked[n].cells, offsets) for n, offsets in known.items()}

    @torch.no_grad()
    def follow(self, place: int) -> None:
        """Find the offsets of the `place`-th frame of `order`; those before it must have been found."""
        index = self.order[place]
        frame = self.frames[index]
        last, earlier = self.route.before[index], self.route.earlier(index)
        resting = {
            name: self._first(name, layer) if last is None else _offsets(layer, last)
            for name, layer in self.tracked.items()
        }
        found = dict(resting)
        if earlier is not None:
            for name, layer in self.tracked.items():
                before = _offsets(layer, earlier)
                found[name] = resting[name] + _FOLLOWING * (resting[name] - before)
        pose = self.poses(frame)
        views = [self.views.view(frame, camera) for camera in self.views.footage.training_cameras]
        rounds, beside = self.config.rounds, self.begun.residuals(frame) if self.begun else {}
        for turn in range(rounds):
            change = self._solve(pose, views, found, resting, beside, fine=turn == rounds - 1)
            found = {name: found[name] + change[name] for name in found}
        for name, layer in self.tracked.items():
            self._store(layer, index, found[name])

    def _described(self) -> Tensor:
        """(K, 198) rotations of the body's joints in every frame, by which poses are told apart."""
        poses = [self.poses(frame).local_transforms[:_BODY_JOINTS, :3, :3].flatten() for frame in self.frames]
        return torch.stack(poses).cpu()

    def _first(self, name: str, layer: _Tracked) -> Floats:
        """Cells (M, 3) m that the first frame starts from: none, or what the layer brings."""
        return self.beginning.get(name, np.zeros((len(layer.cells.where), 3)))

    def _solve(
        self,
        pose: FramePose,
        views: list[View],
        found: dict[str, Floats],
        resting: dict[str, Floats],
        beside: dict[str, Tensor],
        fine: bool,
    ) -> dict[str, Floats]:
        """One Gauss-Newton step: change of every layer's cells (M, 3) m."""
        posed, composite, places = self._composite(pose, found, beside)
        carried = {
            name: blended(layer.model.maps.skin_weights, pose.transforms)[:, :, :3].double().cpu().numpy()
            for name, layer in self.tracked.items()
        }
        equations = {name: Equations.none(len(layer.model.maps)) for name, layer in self.tracked.items()}
        means = composite.means.double().cpu().numpy()
        for view in views:
            picture = render(composite, view.camera)
            shown, wanted = (picture.labels, view.labels) if self.config.labels else (None, None)
            truth = grey_picture(view.image * view.inside[..., None], wanted)
            seen = motion(grey_picture(picture.color, shown), truth, fine)
            if seen is None:
                continue
            depth = picture.depth.double().cpu().numpy()
            for name in self.tracked:
                channel = composite.layers.index(name)
                equations[name].add(
                    means[places[name]],
                    carried[name],
                    view.camera,
                    depth,
                    picture.labels[..., channel].cpu().numpy() > 0.5,
                    (view.inside if wanted is None else wanted[..., channel]).numpy() > 0.5,
                    seen,
                    _PER_METRE,
                )
        for name, layer in self.tracked.items():
            if not layer.model.all_observed:
                equations[name].scale(layer.model.observed.double().cpu().numpy())
        if self.config.collision and BODY in posed:
            for name in self.tracked:
                matrix, right = outwards(posed[name].means, posed[BODY], carried[name], _PER_METRE)
                equations[name].matrix[:] += self.config.collision * matrix
                equations[name].right[:] += self.config.collision * right
        return {
            name: self._step(layer.cells, equations[name], found[name], resting[name])
            for name, layer in self.tracked.items()
        }

    def _composite(
        self, pose: FramePose, found: dict[str, Floats], beside: dict[str, Tensor]
    ) -> tuple[dict[str, PosedGaussians], Gaussians, dict[str, slice]]:
        """All layers in a pose with these offsets, by name and together, and which Gaussians are whose."""
        posed, places, first = {}, {}, 0
        for name, model in self.models.items():
            nothing = model.base_color.new_zeros(len(model.maps), 14)
            attributes = model.attributes(beside.get(name, nothing))
            if name in found:
                moved = torch.from_numpy(self.tracked[name].cells.basis @ found[name]).to(attributes.offsets)
                attributes = replace(attributes, offsets=attributes.offsets + moved)
            posed[name] = pose_layer(model.maps, attributes, pose.transforms, pose.betas)
            places[name] = slice(first, first + len(model.maps))
            first += len(model.maps)
        return posed, compose(posed), places

    def _step(self, cells: Cells, equations: Equations, found: Floats, resting: Floats) -> Floats:
        """Solve data and smoothness for the change: cells stay near `resting` where nothing was seen."""
        config = self.config

        def applied(change: Floats) -> Floats:
            pulled = np.einsum("nab,nb->na", equations.matrix, cells.basis @ change)
            return np.asarray(cells.basis.T @ pulled + smoothness(change) + config.inertia * change)

        def smoothness(values: Floats) -> Floats:
            return np.asarray(
                config.bending * (cells.bending @ values) + config.stretch * (cells.stretch @ values)
            )

        moved = (found - resting) * _PER_METRE
        right = cells.basis.T @ equations.right - config.inertia * moved
        right -= smoothness(found * _PER_METRE - _KEPT * resting * _PER_METRE)
        return conjugate_gradients(applied, right, _SOLVER_STEPS) / _PER_METRE

    def _store(self, layer: _Tracked, index: int, found: Floats) -> None:
        """Keep cells (M, 3), and write them into the anchor's finer maps (2·3, h, w)."""
        layer.found[index] = torch.from_numpy(found).to(layer.found)
        anchor = layer.anchors.offsets.data[index]
        coarse = torch.zeros(4, 2 * layer.size[0] * layer.size[1])
        coarse[:3, layer.cells.where] = layer.found[index].T
        coarse[3, layer.cells.where] = 1.0
        coarse = coarse.view(4, 2, *layer.size).transpose(0, 1)
        fine = functional.interpolate(coarse, anchor.shape[1:], mode="bilinear", align_corners=False)
        there = fine[:, 3:] > 1e-3  # cells that nothing follows do not pull at their neighbours
        values = torch.where(there, fine[:, :3] / fine[:, 3:].clamp(min=1e-3), 0.0)
        anchor.copy_(values.reshape(anchor.shape))


@dataclass(frozen=True)
class Route:
    """In which order frames are followed.

    Attributes:
        order: indices of frames. before: from which frame each is reached; None for the first.
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


def route(groups: list[list[int]], start: int, described: Tensor) -> Route:
    """From `start` to the end of its take and then back to its beginning; then the other takes.

    Another take is entered at the frame whose pose is nearest to one that has been followed.

    Arguments:
        groups: indices of frames by take. described: (K, M) poses of all frames.
    """
    order: list[int] = []
    before: dict[int, int | None] = {}
    entries = []
    for group in sorted(groups, key=lambda group: start not in group):
        begin, known = start, None
        if order:
            distance = torch.cdist(described[group], described[order])
            row, column = divmod(int(distance.argmin()), len(order))
            begin, known = group[row], order[column]
        ahead, back = [i for i in group if i > begin], [i for i in reversed(group) if i < begin]
        before |= {begin: known} | {i: i - 1 for i in ahead} | {i: i + 1 for i in back}
        order += [begin, *ahead, *back]
        entries.append(begin)
    return Route(order, before, frozenset(entries))


def _tracked(model: Decoder, key_poses: KeyPoseOffsets, cell: int) -> _Tracked:
    height, width = key_poses.offsets.shape[2:]
    ratio = max(1, round(cell / key_poses.cell))
    if height % ratio or width % ratio:
        ratio = 1
    size = (height // ratio, width // ratio)
    cells = Cells.of(model.maps, key_poses.points, size)
    found = torch.zeros(len(key_poses.offsets), len(cells.where), 3)
    return _Tracked(model, key_poses, cells, size, found)


def _offsets(layer: _Tracked, index: int) -> Floats:
    """Cells (M, 3) m of an anchor."""
    return np.asarray(layer.found[index].double().numpy())
