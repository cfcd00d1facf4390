"""Simulated garments of an outfit: one simulation that the drivers of all of them share.

The simulation starts at row 0 of a motion, whatever rows are asked for, and keeps every row it has reached.
So a range of frames, a shard and a run that continues show the same cloth as the whole film. Asking for
another motion starts again.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.avatar.decoders.texel_attributes import CHANNELS
from stages.shared.avatar.deform import blended, shaped_positions
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import BodyModel, Poses
from stages.shared.cloth.body_surface import BodyCollider
from stages.shared.cloth.motion import BodyStep, is_cut, lead_in, steps_between
from stages.shared.cloth.pattern import ClothPattern, PatternSkin
from stages.shared.cloth.riding import places
from stages.shared.cloth.riding_kernel import texel_matrices
from stages.shared.cloth.simulator import GRAVITY, Simulator
from stages.shared.outfit.layer import WornLayer

Floats = NDArray[np.float32]


class OutfitSimulation:
    """Garments on a wearer's body through a motion, the inner ones first.

    Arguments:
        body_model: bones and surface. betas: (10,) shape of the wearer.
        patterns: layer name to pattern, inner to outer.
        gravity: (3,) m/s², world. detail: simulation steps over those of the materials.
        keep_steps: whether every step stays in memory, so that another simulation can build on this one.
        beneath: a simulation with `keep_steps` of the inner garments, which are not simulated again. It must
            have reached the rows of the same motion that are asked for.
    """

    def __init__(
        self,
        body_model: BodyModel,
        betas: NDArray,
        patterns: Mapping[str, ClothPattern],
        gravity: tuple[float, float, float] = GRAVITY,
        detail: float = 1.0,
        keep_steps: bool = False,
        beneath: OutfitSimulation | None = None,
    ) -> None:
        self._beneath, self._keep_steps = beneath, keep_steps
        self._steps: list[list[NDArray[np.float64]]] = []
        self._step_count = 0
        self.body_model, self.patterns = body_model, dict(patterns)
        friction = next(iter(self.patterns.values())).material.skin_friction
        self._body = BodyCollider(body_model, betas, friction)
        self._skins = {
            name: PatternSkin(pattern, body_model, betas) for name, pattern in self.patterns.items()
        }
        self._simulator = Simulator(
            self._body.surface,
            [pattern.garment(name) for name, pattern in self.patterns.items()],
            gravity=gravity,
            detail=detail,
        )
        self._poses: Poses | None = None
        self._rows: list[dict[str, Floats]] = []
        self._lock = threading.Lock()

    def positions(self, poses: Poses, row: int) -> dict[str, Floats]:
        """Vertices (V, 3) f32 m, world, of every garment in a row of `poses`."""
        with self._lock:
            if self._poses is not poses and not _same_motion(self._poses, poses):
                self._poses, self._rows, self._steps, self._step_count = poses, [], [], 0
            while len(self._rows) <= row:
                self._advance(poses, len(self._rows))
            return self._rows[row]

    def _advance(self, poses: Poses, row: int) -> None:
        """Simulate the next row and keep it."""
        if is_cut(self.body_model, poses, row):
            pose = next(iter(self.patterns.values())).pose
            steps = list(lead_in(pose, poses, row))
            self._place(steps[0])
            for step in steps[1:]:
                self._step(step)
        else:
            for step in steps_between(poses, row):
                self._step(step)
        states = zip(self.patterns, self._simulator.states, strict=True)
        self._rows.append({name: state.positions.astype(np.float32) for name, state in states})

    def _place(self, step: BodyStep) -> None:
        body = self._body.vertices(step.rotations, step.translation)
        shapes = [
            skin.positions(skin.transforms(step.rotations, step.translation)) for skin in self._skins.values()
        ]
        self._simulator.place(body, shapes)

    def _step(self, step: BodyStep) -> None:
        body = self._body.vertices(step.rotations, step.translation)
        pins = []
        for name, skin in self._skins.items():
            chosen = np.flatnonzero(self.patterns[name].pinned)
            transforms = skin.transforms(step.rotations, step.translation) if len(chosen) else None
            pins.append(np.zeros((0, 3)) if transforms is None else skin.positions(transforms, chosen))
        known = [] if self._beneath is None else self._beneath._steps[self._step_count]
        self._simulator.advance(body, pins, step.seconds, known)
        self._step_count += 1
        if self._keep_steps:
            self._steps.append([state.positions.copy() for state in self._simulator.states])


def _same_motion(one: Poses | None, other: Poses) -> bool:
    return (
        one is not None
        and one.fps == other.fps
        and np.array_equal(one.rotations, other.rotations)
        and np.array_equal(one.translation, other.translation)
    )


class SimulatedDriver:
    """Texels of one garment that ride on its simulated mesh.

    Arguments:
        layer: the garment, with its pattern. simulation: of the outfit. betas: (10,) shape of the wearer.

    Attributes:
        kind: "simulated".
        residual: (N, 14) the decoder's mean over the training poses with offsets that cancel the base's: the
            mesh alone says where the cloth is.
    """

    kind = "simulated"

    def __init__(self, layer: WornLayer, simulation: OutfitSimulation, betas: NDArray) -> None:
        assert layer.cloth is not None
        self._name, self._pattern, self._simulation = layer.name, layer.cloth, simulation
        residual = layer.model.mean_residual_of_training().detach().clone()
        first, last = CHANNELS["offset"]
        residual[:, first:last] = -layer.model.base_offset.detach() / layer.model.model_config.offset_scale
        self.residual: Tensor | None = residual
        self._shaped = shaped_positions(layer.maps, torch.as_tensor(betas, dtype=torch.float32)).numpy()
        self._from_rest = _rest_frames(layer, simulation.body_model)

    def prepare(self, poses: Poses, rows: Sequence[int]) -> None:
        """Simulate up to the last of the rows."""
        if len(rows):
            self._simulation.positions(poses, max(rows))

    def matrices(self, poses: Poses, row: int) -> Tensor:
        """(N, 3, 4) f32 posed_from_canonical of every texel."""
        vertices = self._simulation.positions(poses, row)[self._name]
        pattern = self._pattern
        matrices = np.empty((len(self._shaped), 3, 4), np.float32)
        texel_matrices(
            vertices, pattern.faces, pattern.texel_faces, pattern.texel_weights, pattern.texel_offsets,
            self._from_rest, self._shaped, matrices,
        )  # fmt: skip
        return torch.from_numpy(matrices)


def _rest_frames(layer: WornLayer, body_model: BodyModel) -> Floats:
    """(N, 3, 3) from canonical directions to those of each texel's frame on the mesh, in the template's pose.

    The linear part of the bones depends on the pose alone, not on the shape.
    """
    pattern: Any = layer.cloth
    pose = frame_pose(body_model, torch.from_numpy(pattern.pose), torch.zeros(3), torch.zeros(10))
    linear = blended(layer.maps.skin_weights, pose.transforms)[:, :, :3].numpy()
    _, frames = places(pattern.riding, pattern.rest_vertices, pattern.faces)
    return np.ascontiguousarray(np.einsum("nji,njk->nik", frames, linear), dtype=np.float32)
