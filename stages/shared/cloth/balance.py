"""Rest lengths with which a garment hangs in balance in its template: no sag at the start.

Cloth that is at rest in its template sinks as soon as it has weight: springs stretch, and a step of the
solver leaves them longer than they would be in the end. The simulation itself says by how much. Each round
lets the garment settle in the template's pose and shortens every edge by the ratio of its stretch.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.shared.cloth.simulator import Garment, Simulator
from stages.shared.cloth.surface import Surface

Doubles = NDArray[np.float64]

_LARGEST_CHANGE = 0.15  # of a template length
_SMALLEST_LENGTH = 1e-6  # metres; an edge that collapsed says nothing about its stretch
_ROUNDS = 2
_FRAMES = 24
_FRAME_SECONDS = 1 / 30


def balanced(garment: Garment, surface: Surface, body: Doubles, detail: float = 1.0) -> Garment:
    """The garment with rest lengths that hold it in its template.

    Arguments:
        garment: with the template's lengths at rest.
        surface: what carries the garment. body: (B, 3) m, its vertices in the template's pose.
        detail: simulation steps over those of the material.

    Returns:
        The round whose settled vertices are nearest to the template on average; the garment as it was where
        no round improves it.
    """
    constraints, template = garment.constraints, garment.vertices
    lengths = _edge_lengths(garment, template)
    rest, best, smallest = constraints.edge_rest, garment, np.inf
    for _ in range(_ROUNDS + 1):
        candidate = replace(garment, constraints=constraints._replace(edge_rest=rest))
        settled = _settled(candidate, surface, body, detail)
        distance = float(np.linalg.norm(settled - template, axis=1).mean())
        if distance < smallest:
            best, smallest = candidate, distance
        stretch = lengths / np.maximum(_edge_lengths(garment, settled), _SMALLEST_LENGTH)
        bounds = (1 - _LARGEST_CHANGE) * lengths, (1 + _LARGEST_CHANGE) * lengths
        rest = np.clip(rest * stretch, *bounds)
    return best


def _edge_lengths(garment: Garment, vertices: Doubles) -> Doubles:
    """(E,) metres."""
    ends = vertices[garment.constraints.edges]
    return np.asarray(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))


def _settled(garment: Garment, surface: Surface, body: Doubles, detail: float) -> Doubles:
    """(V, 3) m, after a while on a body that stands still."""
    simulator = Simulator(surface, [garment], detail=detail)
    simulator.place(body, [garment.vertices])
    for _ in range(_FRAMES):
        simulator.advance(body, simulator.pins, _FRAME_SECONDS)
    return simulator.states[0].positions
