"""Several garments on one moving body, the inner ones first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.shared.cloth.constraints import Constraints, build_constraints
from stages.shared.cloth.kernels import advance_frame, limit_strain
from stages.shared.cloth.material import STRAIN_LIMIT, Material
from stages.shared.cloth.surface import Moving, Surface, moving, pack_surfaces
from stages.shared.errors import BadData
from stages.shared.finite import require_finite
from stages.shared.meshes import edges

Doubles = NDArray[np.float64]

GRAVITY = (0.0, -9.81, 0.0)
SKIN_MARGIN = 0.008  # metres that cloth keeps from the body, unless the template is nearer
CLOTH_MARGIN = 0.004  # metres between two garments
_STRAIN_SWEEPS = 300


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment that can be simulated.

    Attributes:
        name: for messages.
        vertices: (V, 3) f64 metres in the template's pose, at rest.
        faces: (F, 3) i32.
        pinned: (V,) vertices that follow the body.
        skin_margin: (V,) metres to keep from the body, see `template_margins`.
        material: see Material.
        constraints: see Constraints.
    """

    name: str
    vertices: Doubles
    faces: NDArray[np.int32]
    pinned: NDArray[np.bool_]
    skin_margin: Doubles
    material: Material
    constraints: Constraints


def garment(
    name: str,
    vertices: NDArray,
    faces: NDArray,
    pinned: NDArray,
    material: Material,
    skin_margin: NDArray | float = SKIN_MARGIN,
) -> Garment:
    """A garment with its constraints; arguments as in `Garment`, errors as in `build_constraints`."""
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    constraints = build_constraints(vertices, faces, pinned, material)
    margin = np.broadcast_to(np.asarray(skin_margin, dtype=np.float64), len(vertices)).copy()
    return Garment(name, vertices, constraints.faces, pinned, margin, material, constraints)


@dataclass(eq=False)
class GarmentState:
    """Where a garment is and how fast it moves: (V, 3) metres, (V, 3) m/s."""

    positions: Doubles
    velocities: Doubles

    def copy(self) -> GarmentState:
        """A state that can be advanced without changing this one."""
        return GarmentState(self.positions.copy(), self.velocities.copy())


@dataclass(eq=False)
class Simulator:
    """Garments on a body, advanced frame by frame.

    Attributes:
        body: the surface that all garments rest on.
        garments: the inner ones first.
        gravity: (3,) m/s².
        detail: steps per second over those of the material.
    """

    body: Surface
    garments: list[Garment]
    gravity: tuple[float, float, float] = GRAVITY
    detail: float = 1.0
    states: list[GarmentState] = field(default_factory=list)
    body_vertices: Doubles = field(init=False)
    pins: list[Doubles] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._surfaces = [
            Surface(one.faces, len(one.vertices), closed=False, friction=one.material.cloth_friction)
            for one in self.garments
        ]
        self._adjacent = [_neighbour_keys(one) for one in self.garments]

    def place(self, body: Doubles, shapes: list[Doubles]) -> None:
        """Put the garments at rest where they are given: body (B, 3), shapes (V, 3) each, metres, world."""
        self.body_vertices = np.array(body, dtype=np.float64)
        self.states = [GarmentState(np.array(s, dtype=np.float64), np.zeros(s.shape)) for s in shapes]
        self.pins = [
            state.positions[one.pinned] for state, one in zip(self.states, self.garments, strict=True)
        ]

    def advance(
        self, body: Doubles, pins: list[Doubles], seconds: float, known: Sequence[Doubles] = ()
    ) -> None:
        """Move on to the next frame.

        Arguments:
            body: (B, 3) metres, world, at the end of the frame.
            pins: per garment (K, 3) where its pinned vertices are then.
            seconds: length of the frame.
            known: (V, 3) positions of the innermost garments at its end, simulated before.

        Raises:
            BadData: the body or a pin is not finite, or a garment's motion left the range of numbers.
        """
        require_finite("cloth simulation", body=body)
        beneath = [moving(self.body, self.body_vertices, body)]
        for index, one in enumerate(self.garments):
            require_finite("cloth simulation", pins=pins[index])
            state = self.states[index]
            before = state.positions.copy()
            if index < len(known):
                state.positions[:] = known[index]
            else:
                self._advance_garment(index, beneath, pins[index], seconds)
            if not np.isfinite(state.positions).all():
                raise BadData(
                    f"The simulation of '{one.name}' left the range of numbers.",
                    "cloth simulation",
                    "Choose '--drive bones' for this garment, or fit its cloth again.",
                )
            beneath.append(moving(self._surfaces[index], before, state.positions))
        self.body_vertices, self.pins = body, list(pins)

    def _advance_garment(self, index: int, beneath: list[Moving], pins: Doubles, seconds: float) -> None:
        one, state = self.garments[index], self.states[index]
        material = one.material
        margins = [one.skin_margin] + [np.full(len(one.vertices), CLOTH_MARGIN)] * index
        surfaces = pack_surfaces(beneath, state.positions, margins)
        substeps = max(1, round(material.steps_per_second * self.detail * seconds))
        if len(pins):
            surfaces.seeds[:, one.pinned] = -1
        advance_frame(
            state.positions,
            state.velocities,
            one.constraints,
            surfaces,
            self._close_pairs(index),
            np.flatnonzero(one.pinned),
            self.pins[index],
            np.asarray(pins, dtype=np.float64),
            np.array(self.gravity, dtype=np.float64),
            float(seconds),
            substeps,
            material.edge_stiffness,
            material.bending,
            material.bending_damping,
            material.drag,
            material.repulsion,
            STRAIN_LIMIT,
        )
        limit_strain(state.positions, one.constraints, STRAIN_LIMIT, _STRAIN_SWEEPS)

    def _close_pairs(self, index: int) -> NDArray[np.int32]:
        """(P, 2) vertices of a garment that could meet within the frame and are not neighbours."""
        one, positions = self.garments[index], self.states[index].positions
        if one.material.repulsion <= 0.0:
            return np.zeros((0, 2), dtype=np.int32)
        pairs = cKDTree(positions).query_pairs(2.5 * one.material.repulsion, output_type="ndarray")
        pairs = np.sort(pairs, axis=1)
        keys = pairs[:, 0] * len(positions) + pairs[:, 1]
        pairs = pairs[~np.isin(keys, self._adjacent[index])]
        return np.ascontiguousarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))], dtype=np.int32)


def _neighbour_keys(one: Garment) -> NDArray[np.int64]:
    """Keys of vertex pairs that share an edge, or are nearer in the template than the repulsion reaches."""
    pairs = edges(one.faces).astype(np.int64)
    if one.material.repulsion > 0.0:
        near = cKDTree(one.vertices).query_pairs(1.5 * one.material.repulsion, output_type="ndarray")
        pairs = np.concatenate([pairs, np.sort(near, axis=1)])
    return np.unique(pairs[:, 0] * len(one.vertices) + pairs[:, 1])
