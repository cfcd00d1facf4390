"""Joints, bone transforms, linear blend skinning and its inverse, shapes."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import torch

from stages.canonicalize.unpose import inverse_skin
from stages.shared.avatar.deform import moved
from stages.shared.body import (
    PARENTS,
    BodyModel,
    bone_transforms,
    embedded_body,
    posed_from_canonical,
    posed_vertices,
    rigid_inverse,
    shaped_joints,
    shaped_vertices,
    skin,
)
from stages.shared.finite import finite
from stages.shared.quaternions import matrices_from_quaternions, unit_quaternions
from tests.benchmarks.stability.function import Function, Inputs, unit, weights

_ANGLES = (0.0, 1e-12, 1e-3, 1.0, math.pi - 1e-7, 2 * math.pi, 1e3, 1e20)
_SHAPES = (0.0, 1e-6, 1.0, 10.0, 1e3, 1e20, 1e38)
_METRES = (0.0, 1e-30, 1e-9, 1.0, 1e3, 1e6, 1e20, 1e38)


@cache
def _body() -> BodyModel:
    return embedded_body()


@cache
def _joints() -> torch.Tensor:
    return shaped_joints(_body(), torch.zeros(10, dtype=torch.float64))


def _pose(angle: float, random: np.random.Generator) -> Inputs:
    return {"rotations": angle * unit(random, 55), "translation": random.normal(size=3)}


def _transforms(angle: float) -> np.ndarray:
    """Bones turned by `angle` about the axes of their limbs."""
    rotations = torch.zeros(55, 3, dtype=torch.float64)
    rotations[:, 0] = angle
    return bone_transforms(rotations, _joints(), PARENTS).numpy()


def _points(metres: float, random: np.random.Generator) -> Inputs:
    return {
        "points": metres * unit(random, 40),
        "weights": weights(random, 40),
        "transforms": _transforms(0.3),
    }


def _twisted(angle: float, random: np.random.Generator) -> Inputs:
    """Points that belong half to a bone and half to one that is turned by `angle` against it."""
    transforms = np.tile(np.eye(4), (55, 1, 1))
    transforms[1, 1:3, 1:3] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    shared = np.zeros((40, 55))
    shared[:, 0] = np.linspace(0.05, 0.95, 40)
    shared[:, 1] = 1 - shared[:, 0]
    return {"world": unit(random, 40), "weights": shared, "transforms": transforms}


def _betas(size: float, random: np.random.Generator) -> Inputs:
    return {"betas": size * random.uniform(-1, 1, 10)}


def _shaped_pose(size: float, random: np.random.Generator) -> Inputs:
    return {**_betas(size, random), "rotations": 0.5 * unit(random, 55), "translation": np.ones(3)}


def _rigid(metres: float, random: np.random.Generator) -> Inputs:
    transforms = _transforms(0.7)
    transforms[:, :3, 3] = metres * unit(random, 55)
    return {"transforms": transforms}


def _ellipsoids(metres: float, random: np.random.Generator) -> Inputs:
    return {
        "scales": metres * random.uniform(0.5, 1, (40, 3)),
        "quaternions": unit(random, 40, 4),
        "matrices": np.concatenate(
            [np.eye(3) + 0.1 * random.normal(size=(40, 3, 3)), unit(random, 40)[..., None]], 2
        ),
        "points": unit(random, 40),
    }


def _carried(a: dict[str, Any]) -> torch.Tensor:
    """Covariance and centre of Gaussians that a blended matrix carries, as `pose_layer` makes them."""
    turned = matrices_from_quaternions(unit_quaternions(a["quaternions"])) * a["scales"][:, None, :]
    spread = a["matrices"][:, :, :3] @ turned
    covariance = (spread @ spread.transpose(1, 2)).flatten(1)
    return finite(torch.cat([covariance, moved(a["points"], a["matrices"])], dim=1), "pose_layer", **a)


SKINNING = (
    Function(
        "bone_transforms", "skinning", "angle of every joint, rad", _ANGLES, _pose,
        lambda a: bone_transforms(a["rotations"], _joints().to(a["rotations"]), PARENTS, a["translation"]),
        everyday=(0.0, 1e3), tolerance=1e-5, gradients=("rotations",), bfloat16=True,
    ),
    Function(
        "posed_from_canonical", "skinning", "angle of every joint, rad", _ANGLES, _pose,
        lambda a: posed_from_canonical(
            _body(), a["rotations"], a["translation"], torch.ones(10, dtype=a["rotations"].dtype)
        ),
        everyday=(0.0, 1e3), tolerance=1e-5, gradients=("rotations",),
    ),
    Function(
        "skin", "skinning", "distance of the points, m", _METRES, _points,
        lambda a: skin(a["points"], a["weights"], a["transforms"]),
        everyday=(0.0, 1e6), tolerance=2e-6, gradients=("points", "transforms"), bfloat16=True,
    ),
    Function(
        "inverse_skin", "skinning", "twist between two bones, rad",
        (0.0, 1e-6, 0.5, 2.0, 2.9, math.pi - 1e-3, math.pi - 1e-7, math.pi), _twisted,
        lambda a: inverse_skin(a["world"], a["weights"], a["transforms"])[0],
        everyday=(0.0, 2.0), tolerance=1e-5, numpy=True,
    ),
    Function(
        "rigid_inverse", "skinning", "translation, m", _METRES, _rigid,
        lambda a: rigid_inverse(a["transforms"]),
        everyday=(0.0, 1e6), tolerance=2e-6, gradients=("transforms",), bfloat16=True,
    ),
    Function(
        "shaped_joints", "shapes", "size of β", _SHAPES, _betas, lambda a: shaped_joints(_body(), a["betas"]),
        everyday=(0.0, 1e3), tolerance=2e-6, gradients=("betas",),
    ),
    Function(
        "shaped_vertices", "shapes", "size of β", _SHAPES, _betas,
        lambda a: shaped_vertices(_body(), a["betas"]), everyday=(0.0, 1e3), tolerance=2e-6,
        gradients=("betas",), bfloat16=True,
    ),
    Function(
        "posed_vertices", "shapes", "size of β", _SHAPES, _shaped_pose,
        lambda a: posed_vertices(_body(), a["rotations"], a["translation"], a["betas"]),
        everyday=(0.0, 1e3), tolerance=1e-5, gradients=("betas", "rotations"),
    ),
    Function(
        "carried Gaussians", "skinning", "standard deviation, m",
        (1e-18, 1e-9, 1e-3, 1.0, 1e3, 1e15, 1e30), _ellipsoids, _carried,
        everyday=(1e-9, 1e3), tolerance=5e-6, gradients=("scales", "quaternions"), bfloat16=True,
    ),
)  # fmt: skip
