"""The fast kernels against the slow reference, colour by colour and thread by thread."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest

from stages.shared.cloth.constraints import build_constraints
from stages.shared.cloth.kernels import advance_frame, limit_strain
from stages.shared.cloth.material import STRAIN_LIMIT, Material
from stages.shared.cloth.reference import nearest_on_triangles, reference_frame
from stages.shared.cloth.simulator import Simulator
from stages.shared.cloth.surface import Surface, moving, pack_surfaces
from tests.shared.cloth.sheets import grid, sheet, sphere

SOFT = Material(edge_stiffness=300.0, bending=5e-5, repulsion=0.02)


@pytest.mark.parametrize("closed", [True, False])
def test_a_frame_equals_the_reference(closed: bool) -> None:
    """All constraints at once: pins that move, a moving sphere below, repulsion, a random start."""
    draw = np.random.default_rng(1)
    one = sheet(5, 5, 0.05, SOFT, pins=(0,))
    ball, faces = sphere(0.3)
    start = one.vertices + [-0.1, 0.31, -0.1] + draw.normal(0, 0.002, one.vertices.shape)
    velocities = draw.normal(0, 0.3, start.shape)
    surface = Surface(faces, len(ball), closed=closed, friction=0.3)
    lifted = moving(surface, ball, ball + [0.01, 0.02, 0.0])
    margins = np.full(len(start), 0.008)
    pairs = np.array([[3, 17], [4, 12]], np.int32)
    pin = np.array([0])
    end = start[pin] + [0.0, 0.01, 0.0]
    gravity = np.array([0.0, -9.81, 0.0])
    fast, speed = start.copy(), velocities.copy()
    advance_frame(
        fast, speed, one.constraints, pack_surfaces([lifted], start, [margins]), pairs, pin, start[pin], end,
        gravity, 1 / 30, 12, SOFT.edge_stiffness, SOFT.bending, SOFT.bending_damping, SOFT.drag,
        SOFT.repulsion, STRAIN_LIMIT,
    )  # fmt: skip
    slow, slow_speed = reference_frame(
        start, velocities, one.constraints, [(lifted, margins)], {0: (start[0], end[0])}, gravity, 1 / 30, 12,
        SOFT, [(3, 17), (4, 12)],
    )  # fmt: skip
    assert np.abs(fast - start).max() > 0.01  # something happened
    np.testing.assert_allclose(fast, slow, atol=1e-9)
    np.testing.assert_allclose(speed, slow_speed, atol=1e-6)


@pytest.mark.parametrize("upright", [True, False])
def test_a_surface_that_faces_the_other_way_does_not_hold_cloth(upright: bool) -> None:
    """It is the underside of a fold of the garment beneath, and would pull cloth into the fold."""
    one = sheet(5, 5, 0.05, SOFT)
    floor, faces = grid(9, 9, 0.05)
    floor = floor - [0.1, 0.0, 0.1]
    surface = Surface(faces if upright else faces[:, ::-1], len(floor), closed=False, friction=0.0)
    simulator = Simulator(surface, [one])
    simulator.place(floor, [one.vertices + [0.0, 0.004, 0.0]])
    for _ in range(6):
        simulator.advance(floor, simulator.pins, 1 / 30)
    height = simulator.states[0].positions[:, 1]
    assert (height > 0.007).all() if upright else (height < -0.1).all()


def test_nearest_points_of_triangles_match_dense_sampling() -> None:
    draw = np.random.default_rng(2)
    corners = draw.normal(size=(20, 3, 3))
    weights = draw.dirichlet(np.ones(3), size=20000)
    for point in draw.normal(size=(4, 3)):
        closest, _ = nearest_on_triangles(point, corners)
        best = np.linalg.norm(closest - point, axis=1)
        sampled = np.linalg.norm(np.einsum("sk,fkc->sfc", weights, corners) - point, axis=2).min(axis=0)
        assert (best <= sampled + 1e-9).all() and np.abs(best - sampled).max() < 0.05


def test_constraints_of_a_colour_share_no_vertex() -> None:
    vertices, faces = grid(7, 6, 0.03)
    built = build_constraints(vertices, faces, np.zeros(len(vertices), bool), SOFT)
    for first, last in zip(built.edge_colors[:-1], built.edge_colors[1:], strict=True):
        assert len(np.unique(built.edges[first:last])) == 2 * (last - first)
    for first, last in zip(built.bend_colors[:-1], built.bend_colors[1:], strict=True):
        slots = slice(built.bend_start[first], built.bend_start[last])
        touched = np.concatenate([built.bend_vertex[first:last], built.bend_ring[slots]])
        assert len(np.unique(touched)) == len(touched)


def test_the_order_within_a_colour_does_not_matter() -> None:
    one = sheet(6, 6, 0.04, SOFT, pins=(0, 5))
    colors = one.constraints.edge_colors
    order = np.concatenate([np.arange(a, b)[::-1] for a, b in pairwise(colors)])
    turned = one.constraints._replace(
        edges=np.ascontiguousarray(one.constraints.edges[order]), edge_rest=one.constraints.edge_rest[order]
    )
    results = []
    for built in (one.constraints, turned):
        x, v = one.vertices.copy(), np.zeros_like(one.vertices)
        empty, pins = np.zeros((0, 2), np.int32), np.array([0, 5])
        advance_frame(
            x, v, built, pack_surfaces([], x, []), empty, pins, x[pins], x[pins],
            np.array([0.0, -9.81, 0.0]), 1 / 30, 20, 300.0, 5e-5, 0.1, 3.5, 0.0, STRAIN_LIMIT,
        )  # fmt: skip
        results.append(x.tobytes())
    assert results[0] == results[1]


def test_threads_do_not_change_the_bytes() -> None:
    def fall(_: int) -> bytes:
        ball, faces = sphere(0.2)
        one = sheet(8, 8, 0.05, SOFT)
        simulator = Simulator(Surface(faces, len(ball), closed=True, friction=0.2), [one])
        simulator.place(ball, [one.vertices + [-0.17, 0.25, -0.17]])
        for _ in range(6):
            simulator.advance(ball, simulator.pins, 1 / 30)
        return simulator.states[0].positions.tobytes()

    alone = fall(0)
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(fall, range(4))) == [alone] * 4


def test_strain_is_limited() -> None:
    one = sheet(6, 6, 0.04, SOFT)
    stretched = one.vertices * [2.5, 1.0, 1.0]
    assert limit_strain(stretched, one.constraints, STRAIN_LIMIT, 500) == 0
    ends = stretched[one.constraints.edges]
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    assert (lengths <= STRAIN_LIMIT * one.constraints.edge_rest * (1 + 1e-6)).all()
