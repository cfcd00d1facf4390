"""Fit the body to a mesh of a dressed person: unit, orientation, place, pose and shape.

Coarse to fine: all axis-aligned orientations whose box fits, with few points and the large joints; the best
few with all body joints; the best one with many points.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.register_template.fit_points import (
    BodySamples,
    MeshSamples,
    body_samples,
    find_pairs,
    mesh_samples,
    residual,
)
from stages.shared.body import BodyModel, Poses, posed_vertices
from stages.shared.body.skeleton import EXPRESSION_COUNT, JOINT_COUNT, JOINT_INDEX, SHAPE_COUNT
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.report import Report

Doubles = NDArray[np.float64]

# Metres per unit: metre, centimetre, millimetre, inch, foot.
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
_SHORTEST, _LONGEST = 1.2, 2.4  # largest side of a person's box, metres
_ARM_ANGLES = (0.0, 0.8)  # how far the arms hang down at the start, radians: T-pose, A-pose
_LARGE_JOINTS = tuple(
    f"{side}_{name}" for side in ("left", "right") for name in ("hip", "knee", "shoulder", "elbow")
)
_KEPT = (4, 1)  # starts kept after the first and the second level
_PAIR_STEPS = 3  # steps for which nearest points stay paired
_BOX_TOLERANCE = 1.35  # by which factor the boxes of body and mesh may differ in any axis
# Body points, mesh points, robust distance (m), share of the steps.
_LEVELS = ((400, 800, 0.25, 0.2), (1200, 2400, 0.10, 0.6), (4000, 8000, 0.05, 1.0))
_POSE_PRIOR, _SHAPE_PRIOR, _LIMIT_PRIOR = 2e-5, 4e-6, 5e-3


@dataclass(frozen=True, eq=False)
class Fit:
    """A mesh in metres and y up, and the pose and shape of the body inside of it."""

    mesh: Mesh
    poses: Poses
    report: dict[str, Any]


@dataclass
class _Start:
    """A guess: how the mesh is turned, and the body's parameters (float64 tensors)."""

    turn: Doubles
    rotations: Tensor
    translation: Tensor
    betas: Tensor
    loss: float = float("inf")


def fit_body(body: BodyModel, mesh: Mesh, steps: int, report: Report) -> Fit:
    """Fit the body model to a mesh.

    Arguments:
        mesh: of one standing person; any unit of `_UNITS`, any axis up.
        steps: optimisation steps of the finer levels.

    Returns:
        The mesh turned upright, in metres, and a sequence of one pose in the same frame.

    Raises:
        BadData: the mesh is not of a person's size in any unit.
    """
    unit, scale = _unit(mesh)
    middle = (mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0)).astype(np.float64) / 2
    size = scale * (mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)).astype(np.float64)
    starts = [_start(body, turn, angle) for turn in axis_rotations() for angle in _ARM_ANGLES]
    starts = [start for start in starts if _same_box(body, start, size)] or starts
    for level, (body_count, mesh_count, robust, share) in enumerate(_LEVELS):
        samples, points = body_samples(body, body_count), mesh_samples(mesh, mesh_count)
        count = max(5, round(steps * share))
        for number, start in enumerate(starts):
            target = points.turned(start.turn, scale, -scale * start.turn @ middle)
            _descend(start, samples, target, robust, count, level)
            report.progress(number + 1, len(starts), loss=start.loss)
        starts.sort(key=lambda start: start.loss)
        if level < len(_KEPT):
            starts = starts[: _KEPT[level]]
    best = starts[0]
    upright = replace(mesh, vertices=(scale * mesh.vertices @ best.turn.T).astype(np.float32))
    poses = Poses(
        best.rotations.numpy()[None],
        best.translation.numpy()[None] + scale * best.turn @ middle,
        best.betas.numpy(),
        np.zeros((1, EXPRESSION_COUNT), np.float32),
    )
    told = {
        "parameters": "fitted",
        "unit": unit,
        "metres_per_unit": scale,
        "loss": best.loss,
        "turn": best.turn.tolist(),
    }
    return Fit(upright, poses, told)


def axis_rotations() -> list[Doubles]:
    """The 24 rotations that permute the axes, as (3, 3)."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return found


def _unit(mesh: Mesh) -> tuple[str, float]:
    """The unit in which the mesh is as large as a person, metres first."""
    size = float((mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)).max())
    for name, metres in _UNITS.items():
        if _SHORTEST <= size * metres <= _LONGEST:
            return name, metres
    raise BadData(
        f"The mesh is {size:.4g} units large: a person's size in none of the units {', '.join(_UNITS)}.",
        f"mesh of {len(mesh.vertices)} vertices",
        "Scale the mesh to metres, or give the body fit with --params.",
    )


def _start(body: BodyModel, turn: Doubles, arm_angle: float) -> _Start:
    rotations = torch.zeros(JOINT_COUNT, 3, dtype=torch.float64)
    rotations[JOINT_INDEX["left_shoulder"], 2] = -arm_angle
    rotations[JOINT_INDEX["right_shoulder"], 2] = arm_angle
    # The middle of the body's box lies at the origin, where the mesh's is.
    middle = (body.template_vertices.max(axis=0) + body.template_vertices.min(axis=0)) / 2
    translation = torch.from_numpy(-middle.astype(np.float64))
    return _Start(turn, rotations, translation, torch.zeros(SHAPE_COUNT, dtype=torch.float64))


def _same_box(body: BodyModel, start: _Start, size: Doubles) -> bool:
    """Whether the start's body is about as wide, tall and deep as the turned mesh of box `size` (3,)."""
    with torch.no_grad():
        points = posed_vertices(body, start.rotations, start.translation, start.betas).numpy()
    ratio = np.abs(start.turn) @ size / (points.max(axis=0) - points.min(axis=0))
    # The depth says little: a step forward or a wide skirt changes it by factors.
    return bool(max(ratio[0], 1 / ratio[0], ratio[1], 1 / ratio[1]) < _BOX_TOLERANCE)


def _descend(
    start: _Start, samples: BodySamples, target: MeshSamples, robust: float, steps: int, level: int
) -> None:
    """Improve a start in place by Adam; deeper levels free more joints and more of the shape."""
    rotations = start.rotations.clone().requires_grad_()
    translation = start.translation.clone().requires_grad_()
    betas = start.betas.clone().requires_grad_()
    free_joints, free_betas = _freedom(level)
    initial = start.rotations.clone()
    optimiser = torch.optim.Adam(
        [
            {"params": [rotations], "lr": 0.04 if level == 0 else 0.02},
            {"params": [translation], "lr": 0.02 if level == 0 else 0.008},
            {"params": [betas], "lr": 0.10 if level == 0 else 0.06},
        ]
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, eta_min=1e-4)
    for step in range(steps):
        optimiser.zero_grad()
        points, normals = samples.posed(rotations, translation, betas)
        if step % _PAIR_STEPS == 0:
            pairs = find_pairs(points, normals, target)
        fit = residual(points, pairs, robust)
        loss = fit + _prior(rotations, betas, initial, level)
        loss.backward()
        for values, mask in ((rotations, free_joints), (betas, free_betas)):
            if values.grad is not None:
                values.grad *= mask
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        points, normals = samples.posed(rotations, translation, betas)
        start.loss = float(residual(points, find_pairs(points, normals, target), robust))
    start.rotations, start.translation, start.betas = (
        values.detach().clone() for values in (rotations, translation, betas)
    )


def _freedom(level: int) -> tuple[Tensor, Tensor]:
    """Which joints (55, 1) and betas (10,) may move."""
    joints = torch.zeros(JOINT_COUNT, 1, dtype=torch.float64)
    joints[0] = 1
    joints[[JOINT_INDEX[name] for name in _LARGE_JOINTS]] = 1
    betas = torch.ones(SHAPE_COUNT, dtype=torch.float64)
    if level == 0:
        betas[2:] = 0
    else:
        joints[1:22] = 1
    return joints, betas


def _prior(rotations: Tensor, betas: Tensor, initial: Tensor, level: int) -> Tensor:
    """Small angles, small betas, and knees and elbows that bend one way only."""
    weights = torch.ones(JOINT_COUNT, 1, dtype=torch.float64)
    weights[0] = 0
    weights[[JOINT_INDEX[name] for name in _LARGE_JOINTS]] = 0.2
    weights[
        [JOINT_INDEX[f"{side}_{name}"] for side in ("left", "right") for name in ("wrist", "ankle", "foot")]
    ] = 6
    reference = initial if level == 0 else torch.zeros_like(initial)
    angles = (weights * (rotations - reference) ** 2).sum()
    knees = rotations[[JOINT_INDEX["left_knee"], JOINT_INDEX["right_knee"]]]
    elbows = rotations[[JOINT_INDEX["left_elbow"], JOINT_INDEX["right_elbow"]]]
    forward = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    beyond = (
        torch.relu(-knees[:, 0]).square().sum()
        + knees[:, 1:].square().sum()
        + torch.relu(-elbows[:, 1] * forward).square().sum()
    )
    return _POSE_PRIOR * angles + _SHAPE_PRIOR * betas.square().sum() + _LIMIT_PRIOR * beyond
