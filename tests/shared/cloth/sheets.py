"""Small pieces of cloth and surfaces for the tests of the cloth engine."""

from __future__ import annotations

import numpy as np

from stages.shared.cloth.material import Material
from stages.shared.cloth.simulator import Garment, Simulator, garment
from stages.shared.cloth.surface import Surface

NOTHING = Surface(np.zeros((0, 3), np.int32), 0, closed=True, friction=0.0)
NOWHERE = np.zeros((0, 3))
STIFF = Material(drag=0.0, bending=0.0)


def grid(columns: int, rows: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet in the x-z plane: vertices (V, 3), faces that look up."""
    x, z = np.meshgrid(np.arange(columns) * size, np.arange(rows) * size, indexing="ij")
    vertices = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    faces = []
    for i in range(columns - 1):
        for j in range(rows - 1):
            a, b = i * rows + j, (i + 1) * rows + j
            faces += [[a, a + 1, b], [b, a + 1, b + 1]]
    return vertices, np.array(faces, np.int32)


def sphere(radius: float, rings: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere around the origin: vertices (V, 3), faces that look outward."""
    import trimesh

    ball = trimesh.creation.uv_sphere(radius=radius, count=[rings, 2 * rings])
    return np.array(ball.vertices), np.array(ball.faces, np.int32)


def sheet(columns: int, rows: int, size: float, material: Material, pins: tuple[int, ...] = ()) -> Garment:
    """A flat sheet as a garment."""
    vertices, faces = grid(columns, rows, size)
    pinned = np.zeros(len(vertices), bool)
    pinned[list(pins)] = True
    return garment("sheet", vertices, faces, pinned, material)


def free_simulation(one: Garment, start: np.ndarray | None = None) -> Simulator:
    """The garment without a body, at rest where it is or at `start` (V, 3)."""
    simulator = Simulator(NOTHING, [one])
    simulator.place(NOWHERE, [one.vertices if start is None else start])
    return simulator


def run_free(simulator: Simulator, frames: int, seconds: float = 1 / 30) -> np.ndarray:
    """Advance with still pins and no body; positions (V, 3) at the end."""
    for _ in range(frames):
        simulator.advance(NOWHERE, simulator.pins, seconds)
    return simulator.states[0].positions
