"""Axis-angle, quaternions, and turns between directions."""

from __future__ import annotations

import math

import numpy as np

from stages.shared.body import kinematics
from stages.shared.capture.rotation import rotation_of_axis_angle
from stages.shared.quaternions import matrices_from_quaternions, quaternion_from_z, slerp, unit_quaternions
from tests.benchmarks.stability.function import Function, Inputs, unit

_ANGLES = (0.0, 1e-30, 1e-12, 1e-6, 1e-3, 1.0, math.pi - 1e-7, 2 * math.pi, 1e2, 1e4, 1e6, 1e20)
_LENGTHS = (0.0, 1e-30, 1e-12, 1e-3, 1.0, 1e3, 1e12, 1e30)


def _axis_angle(angle: float, random: np.random.Generator) -> Inputs:
    return {"axis_angle": angle * unit(random, 12)}


def _quaternions(length: float, random: np.random.Generator) -> Inputs:
    return {"quaternions": length * unit(random, 12, 4)}


def _pairs(angle: float, random: np.random.Generator) -> Inputs:
    start = unit(random, 12, 4)
    across = random.normal(size=(12, 4))
    across -= (across * start).sum(axis=1, keepdims=True) * start
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    end = math.cos(angle) * start + math.sin(angle) * across
    return {"start": start, "end": end, "weights": random.random((12, 1))}


def _near_minus_z(angle: float, random: np.random.Generator) -> Inputs:
    turn = random.random(12) * 2 * math.pi
    x, y = math.sin(angle) * np.cos(turn), math.sin(angle) * np.sin(turn)
    return {"normals": np.stack([x, y, np.full(12, -math.cos(angle))], axis=1)}


def _one_vector(angle: float, random: np.random.Generator) -> Inputs:
    return {"axis_angle": angle * unit(random, 1)[0]}


ROTATIONS = (
    Function(
        "rotation_matrices", "rotations", "angle, rad", _ANGLES, _axis_angle,
        lambda a: kinematics.rotation_matrices(a["axis_angle"]),
        everyday=(0.0, 1e6), tolerance=2e-6, gradients=("axis_angle",), gradient_tolerance=1e-5,
        bfloat16=True,
    ),
    Function(
        "rotation_of_axis_angle", "rotations", "angle, rad", _ANGLES, _one_vector,
        lambda a: rotation_of_axis_angle(a["axis_angle"].astype(np.float64)),
        everyday=(0.0, 1e6), numpy=True,
    ),
    Function(
        "unit_quaternions", "rotations", "length", _LENGTHS, _quaternions,
        lambda a: matrices_from_quaternions(unit_quaternions(a["quaternions"])),
        everyday=(1e-3, 1e12), tolerance=2e-6, gradients=("quaternions",), bfloat16=True,
    ),
    Function(
        "slerp", "rotations", "angle on the sphere, rad",
        (0.0, 1e-8, 1e-4, 1e-2, 1.0, math.pi / 2 - 1e-7, 3.0, math.pi - 1e-7), _pairs,
        lambda a: slerp(a["start"], a["end"], a["weights"]),
        everyday=(0.0, 1.0), tolerance=1e-5, gradients=("start", "end"), gradient_tolerance=1e-3,
    ),
    Function(
        "quaternion_from_z", "rotations", "angle from −z, rad", (0.0, 1e-8, 1e-4, 1e-2, 1.0, math.pi),
        _near_minus_z,
        lambda a: quaternion_from_z(a["normals"]), everyday=(1e-2, math.pi), tolerance=1e-4,
    ),
)  # fmt: skip
