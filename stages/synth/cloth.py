"""Extended position-based dynamics for cloth (Macklin et al. 2016, 2019: small steps, one sweep each).

The functions work on one garment, in place, on f64 arrays; they are compiled and release the interpreter
lock, so that two people can be simulated side by side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.shared.meshes import edges as edges_of

Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

GRAVITY = -9.81
MAX_SPEED = 6.0  # m/s; faster cloth could jump through an arm within a step


@dataclass(frozen=True, eq=False)
class ClothModel:
    """What keeps a garment together.

    Attributes:
        edges: (E, 2) neighbours; rest_lengths: (E,) metres. They cannot stretch.
        wings: (B, 2) the two vertices opposite an inner edge; wing_lengths: (B,) metres. They bend softly.
        bend_compliance: inverse stiffness of the wings, m/N with unit vertex masses.
        drag: share of the velocity lost per second.
    """

    edges: Indices
    rest_lengths: Doubles
    wings: Indices
    wing_lengths: Doubles
    bend_compliance: float = 1e-4
    drag: float = 1.6


def cloth_model(vertices: Doubles, faces: Indices) -> ClothModel:
    """Constraints of a garment whose unstretched shape is given (V, 3) metres, faces (F, 3)."""
    edges = edges_of(faces).astype(np.int64)
    edges = edges[np.lexsort((edges[:, 1], -vertices[edges].mean(axis=1)[:, 1].round(3)))]
    wings = _wings(faces)
    return ClothModel(edges, _lengths(vertices, edges), wings, _lengths(vertices, wings))


def stretch_of(model: ClothModel, positions: Doubles) -> Doubles:
    """(E,) length of each edge over its rest length."""
    return _lengths(positions, model.edges) / model.rest_lengths


@njit(cache=True, nogil=True)
def predict(positions, previous, velocities, seconds, drag):  # type: ignore[no-untyped-def]
    """Store where the vertices are and move them by velocity and gravity."""
    keep = max(0.0, 1.0 - drag * seconds)
    for i in range(len(positions)):
        speed = 0.0
        for k in range(3):
            velocities[i, k] *= keep
        velocities[i, 1] += GRAVITY * seconds
        for k in range(3):
            speed += velocities[i, k] ** 2
        limit = min(1.0, MAX_SPEED / (np.sqrt(speed) + 1e-12))
        for k in range(3):
            velocities[i, k] *= limit
            previous[i, k] = positions[i, k]
            positions[i, k] += seconds * velocities[i, k]


@njit(cache=True, nogil=True)
def solve_distances(positions, pairs, lengths, compliance, seconds, sweeps):  # type: ignore[no-untyped-def]
    """Gauss-Seidel sweeps over distance constraints, back and forth (compliance 0: rigid)."""
    softness = compliance / (seconds * seconds)
    count = len(pairs)
    for turn in range(sweeps * count):
        c = turn % count
        if (turn // count) % 2 == 1:
            c = count - 1 - c
        a, b = pairs[c, 0], pairs[c, 1]
        dx = positions[a, 0] - positions[b, 0]
        dy = positions[a, 1] - positions[b, 1]
        dz = positions[a, 2] - positions[b, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length < 1e-9:
            continue
        # Both masses are 1: the gradient's weight is 2.
        step = (length - lengths[c]) / ((2.0 + softness) * length)
        positions[a, 0] -= step * dx
        positions[a, 1] -= step * dy
        positions[a, 2] -= step * dz
        positions[b, 0] += step * dx
        positions[b, 1] += step * dy
        positions[b, 2] += step * dz


@njit(cache=True, nogil=True)
def damp_distances(positions, velocities, pairs, share):  # type: ignore[no-untyped-def]
    """Take out a share of the speed at which the two ends of each pair part or approach.

    Without it the sweeps above leave a jitter of single edges that never dies.
    """
    for c in range(len(pairs)):
        a, b = pairs[c, 0], pairs[c, 1]
        dx = positions[a, 0] - positions[b, 0]
        dy = positions[a, 1] - positions[b, 1]
        dz = positions[a, 2] - positions[b, 2]
        squared = dx * dx + dy * dy + dz * dz + 1e-18
        parting = dx * (velocities[a, 0] - velocities[b, 0])
        parting += dy * (velocities[a, 1] - velocities[b, 1])
        parting += dz * (velocities[a, 2] - velocities[b, 2])
        step = 0.5 * share * parting / squared
        velocities[a, 0] -= step * dx
        velocities[a, 1] -= step * dy
        velocities[a, 2] -= step * dz
        velocities[b, 0] += step * dx
        velocities[b, 1] += step * dy
        velocities[b, 2] += step * dz


@njit(cache=True, nogil=True)
def hold_pins(positions, targets, pinned, seconds):  # type: ignore[no-untyped-def]
    """Pull pinned vertices to their place on the body: all the way for 1, softly below."""
    for i in range(len(positions)):
        if pinned[i] <= 0.0:
            continue
        pull = 1.0 if pinned[i] >= 1.0 else 1.0 - (1.0 - pinned[i]) ** (seconds * 120.0)
        for k in range(3):
            positions[i, k] += pull * (targets[i, k] - positions[i, k])


@njit(cache=True, nogil=True)
def update_velocities(positions, previous, velocities, seconds):  # type: ignore[no-untyped-def]
    """Velocity is what the step really moved."""
    for i in range(len(positions)):
        for k in range(3):
            velocities[i, k] = (positions[i, k] - previous[i, k]) / seconds


@njit(cache=True, nogil=True)
def area_normals(positions, faces, normals):  # type: ignore[no-untyped-def]
    """Unit vertex normals, area weighted, written to normals (V, 3)."""
    normals[:] = 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = (
            positions[b, 0] - positions[a, 0],
            positions[b, 1] - positions[a, 1],
            positions[b, 2] - positions[a, 2],
        )
        vx, vy, vz = (
            positions[c, 0] - positions[a, 0],
            positions[c, 1] - positions[a, 1],
            positions[c, 2] - positions[a, 2],
        )
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for i in (a, b, c):
            normals[i, 0] += nx
            normals[i, 1] += ny
            normals[i, 2] += nz
    for i in range(len(normals)):
        length = np.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2) + 1e-20
        for k in range(3):
            normals[i, k] /= length


def _lengths(points: Doubles, pairs: Indices) -> Doubles:
    return np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)


def _wings(faces: Indices) -> Indices:
    """(B, 2) vertices opposite each inner edge."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    key = np.sort(edges, axis=1)
    order = np.lexsort((key[:, 1], key[:, 0]))
    key, opposite = key[order], opposite[order]
    same = np.flatnonzero((key[1:] == key[:-1]).all(axis=1))
    return np.stack([opposite[same], opposite[same + 1]], axis=1)
