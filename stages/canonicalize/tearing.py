"""Faces torn by the change of pose: detected by the growth of their edges, and removed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Tears:
    """Edges that grew too much.

    Attributes:
        faces: (F',3) the faces that are left.
        torn_edges: how many edges grew by more than the limit.
        cut_faces: how many faces were taken away with them.
        largest_growth: of all edges longer than the noise limit afterwards.
    """

    faces: np.ndarray
    torn_edges: int
    cut_faces: int
    largest_growth: float


def cut_tears(
    faces: np.ndarray, before: np.ndarray, after: np.ndarray, growth: float, shortest: float
) -> Tears:
    """Drop faces with an edge that is `growth` times longer `after` than `before` and longer than `shortest`.

    Arguments:
        faces: (F, 3). before, after: (V, 3) metres.
    """
    factor = edge_growth(faces, before, after, shortest)
    torn = factor > growth
    edges = np.sort(np.stack((faces, np.roll(faces, -1, axis=1)), axis=2)[torn], axis=1)
    intact = faces[~torn.any(axis=1)]
    return Tears(
        intact, len(np.unique(edges, axis=0)), len(faces) - len(intact), float(factor.max(initial=0.0))
    )


def edge_growth(faces: np.ndarray, before: np.ndarray, after: np.ndarray, shortest: float) -> np.ndarray:
    """(F, 3) length of each edge `after` over `before`; 1 where it is not longer than `shortest` metres."""
    ends = faces, np.roll(faces, -1, axis=1)
    length_before = np.linalg.norm(before[ends[0]] - before[ends[1]], axis=2)
    length_after = np.linalg.norm(after[ends[0]] - after[ends[1]], axis=2)
    return np.where(length_after > shortest, length_after / np.maximum(length_before, 1e-6), 1.0)
