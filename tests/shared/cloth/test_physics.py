"""What cloth must do, against formulas: springs, pendulum, friction, momentum, energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.shared.cloth.balance import balanced
from stages.shared.cloth.material import STRAIN_LIMIT, Material
from stages.shared.cloth.simulator import Simulator, garment
from stages.shared.cloth.surface import Surface
from tests.shared.cloth.sheets import NOTHING, NOWHERE, STIFF, free_simulation, grid, run_free, sheet, sphere


def test_a_hanging_strip_stretches_by_its_own_weight() -> None:
    """Springs in a row lengthen by the weight below each over their stiffness."""
    stiffness = 40.0
    soft = Material(edge_stiffness=stiffness, bending=0.0, drag=4.0, steps_per_second=3000)
    vertices = np.stack([np.zeros(9), -0.05 * np.arange(9), np.zeros(9)], axis=1)
    wide = np.concatenate([vertices, vertices + [0.05, 0.0, 0.0]])
    faces = np.array([[i, i + 9, i + 1] for i in range(8)] + [[i + 1, i + 9, i + 10] for i in range(8)])
    pinned = np.zeros(18, bool)
    pinned[[0, 9]] = True
    one = garment("strip", wide, faces, pinned, soft)
    end = run_free(free_simulation(one), 60)
    # Bounds: two columns carry it alone, or the diagonals help as if they were almost two more.
    mass = 1.0 / one.constraints.inverse_mass[~pinned]
    below = np.array([mass[wide[~pinned][:, 1] < -0.05 * i - 0.01].sum() for i in range(8)])
    alone = (below * 9.81 / (2 * stiffness)).sum()
    shared = (below * 9.81 / (3.5 * stiffness)).sum()
    fall = (wide[:, 1] - end[:, 1])[[8, 17]].mean()
    assert shared < fall < 1.05 * alone


def test_a_hanging_chain_takes_the_form_of_a_catenary() -> None:
    """A narrow strip between two pins: its sag is that of the catenary of its length and span."""
    length, span, count = 1.2, 0.9, 41
    along = np.linspace(0, length, count)
    strip = np.concatenate([np.stack([along, 0 * along, z + 0 * along], axis=1) for z in (0.0, 0.03)])
    faces = np.array(
        [[i, count + i, i + 1] for i in range(count - 1)]
        + [[i + 1, count + i, count + i + 1] for i in range(count - 1)]
    )
    pins = np.array([0, count - 1, count, 2 * count - 1])
    pinned = np.zeros(2 * count, bool)
    pinned[pins] = True
    one = garment("chain", strip, faces, pinned, replace(STIFF, drag=3.0))
    start = strip.copy()
    start[:, 0] *= span / length
    start[:, 1] = -0.3 * np.sin(np.pi * np.tile(along, 2) / length)
    end = run_free(free_simulation(one, start), 60)
    a = np.linspace(0.05, 2.0, 20000)  # catenary of parameter a: length 2 a sinh(span / 2a)
    a = a[np.argmin(np.abs(2 * a * np.sinh(span / (2 * a)) - length))]
    assert -end[:, 1].min() == pytest.approx(a * (np.cosh(span / (2 * a)) - 1), rel=0.02)


def test_a_pendulum_swings_in_the_right_time() -> None:
    """A light stiff triangle on two pins: a physical pendulum with the mass of its free vertex."""
    length = 0.25
    vertices = np.array([[0.0, 0.0, -0.02], [0.0, 0.0, 0.02], [0.0, -length, 0.0]])
    pinned = np.array([True, True, False])
    one = garment("pendulum", vertices, np.array([[0, 1, 2]]), pinned, replace(STIFF, steps_per_second=3000))
    angle = 0.15
    start = vertices.copy()
    start[2] = [length * np.sin(angle), -length * np.cos(angle), 0.0]
    simulator = free_simulation(one, start)
    swing = []
    for _ in range(240):
        simulator.advance(NOWHERE, simulator.pins, 1 / 120)
        swing.append(simulator.states[0].positions[2, 0])
    crossings = np.flatnonzero(np.diff(np.sign(swing)))
    period = 2 * np.diff(crossings).mean() / 120
    exact = 2 * np.pi * np.sqrt(length / 9.81) * (1 + angle**2 / 16)
    assert period == pytest.approx(exact, rel=0.03)


def test_energy_never_grows_and_momentum_stays() -> None:
    one = sheet(6, 6, 0.05, Material(drag=0.0, edge_stiffness=500.0, bending=0.0))
    draw = np.random.default_rng(3)
    simulator = Simulator(NOTHING, [one], gravity=(0.0, 0.0, 0.0))
    simulator.place(NOWHERE, [one.vertices + draw.normal(0, 0.003, one.vertices.shape)])
    velocities = draw.normal(0, 0.5, one.vertices.shape)
    simulator.states[0].velocities[:] = velocities
    mass = 1.0 / one.constraints.inverse_mass
    momentum = (mass[:, None] * velocities).sum(axis=0)
    energy = [_energy(simulator)]
    for _ in range(20):
        simulator.advance(NOWHERE, simulator.pins, 1 / 30)
        energy.append(_energy(simulator))
    now = (mass[:, None] * simulator.states[0].velocities).sum(axis=0)
    np.testing.assert_allclose(now, momentum, atol=1e-7 * np.abs(momentum).max() + 1e-9)
    assert (np.diff(energy) <= 1e-4 * energy[0]).all() and energy[-1] < energy[0]


@pytest.mark.parametrize(("friction", "slides"), [(0.7, False), (0.4, True)])
def test_cloth_sticks_on_a_slope_below_coulombs_threshold(friction: float, slides: bool) -> None:
    """On a slope of 30 degrees the threshold is tan 30 = 0.577; above it the acceleration is known."""
    angle = np.radians(30)
    plane, faces = grid(2, 2, 8.0)
    surface = Surface(faces, 4, closed=True, friction=friction)
    one = sheet(4, 4, 0.05, replace(STIFF, steps_per_second=1200))
    turned = (9.81 * np.sin(angle), -9.81 * np.cos(angle), 0.0)
    simulator = Simulator(surface, [one], gravity=turned)
    simulator.place(plane, [one.vertices + [1.0, 0.008, 4.0]])
    for _ in range(30):
        simulator.advance(plane, simulator.pins, 1 / 30)
    moved = (simulator.states[0].positions - one.vertices)[:, 0].mean() - 1.0
    exact = 0.5 * 9.81 * (np.sin(angle) - friction * np.cos(angle)) if slides else 0.0
    assert moved == pytest.approx(exact, rel=0.03, abs=0.002)


def test_a_sheet_follows_a_sphere_that_moves() -> None:
    """Friction carries it along; it neither falls through nor slips off, at a walking speed."""
    ball, faces = sphere(0.25)
    one = sheet(11, 11, 0.05, Material(skin_friction=0.6))
    simulator = Simulator(Surface(faces, len(ball), closed=True, friction=0.6), [one])
    simulator.place(ball, [one.vertices + [-0.25, 0.26, -0.25]])
    for frame in range(45):
        centre = np.array([max(frame - 15, 0) * 1.0 / 30 * min(max(frame - 15, 0) / 15, 1), 0.0, 0.0])
        simulator.advance(ball + centre, simulator.pins, 1 / 30)
    at = simulator.states[0].positions - centre
    assert np.linalg.norm(at, axis=1).min() > 0.245  # the sphere's facets lie inside its radius
    assert abs(at[:, 0].mean()) < 0.08 and np.abs(at[60]).max() < 0.3


def test_the_start_does_not_sag() -> None:
    """Rest lengths in balance hold the template where it is; unbalanced ones let it down."""
    vertices, faces = grid(9, 6, 0.04)
    hanging = np.stack([vertices[:, 2], -vertices[:, 0], 0.002 * np.sin(9 * vertices[:, 2])], axis=1)
    pinned = hanging[:, 1] > -1e-6
    soft = Material(edge_stiffness=15.0, balanced=True)
    one = garment("curtain", hanging, faces, pinned, soft)
    falls = []
    for worn in (one, balanced(one, NOTHING, NOWHERE)):
        end = run_free(free_simulation(worn), 20)
        falls.append(np.linalg.norm(end - hanging, axis=1).max())
    assert falls[1] < 0.2 * falls[0] and falls[1] < 0.003


@pytest.mark.parametrize("gravity", [(0.0, 9.81, 0.0), (50.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("steps", [1.0, 600.0])
def test_extreme_settings_stay_finite_and_limited(gravity: tuple[float, float, float], steps: float) -> None:
    """One substep a frame, gravity in any direction, a body that jumps: finite and within the limit."""
    ball, faces = sphere(0.2)
    one = sheet(7, 7, 0.05, Material(steps_per_second=steps), pins=(0, 6))
    simulator = Simulator(Surface(faces, len(ball), closed=True, friction=0.3), [one], gravity=gravity)
    simulator.place(ball, [one.vertices + [-0.15, 0.21, -0.15]])
    pins = simulator.pins
    draw = np.random.default_rng(4)
    for _ in range(8):
        simulator.advance(ball + draw.normal(0, 0.05, 3), pins, 1 / 30)
    at = simulator.states[0].positions
    ends = at[one.constraints.edges]
    stretch = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / one.constraints.edge_rest
    assert np.isfinite(at).all() and stretch.max() < STRAIN_LIMIT * 1.05
    assert np.abs(at).max() < 1.5


def test_a_garment_of_one_triangle_falls_as_it_should() -> None:
    vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0, 0.1]])
    one = garment("triangle", vertices, np.array([[0, 2, 1]]), np.zeros(3, bool), STIFF)
    end = run_free(free_simulation(one), 30)
    np.testing.assert_allclose(end[:, 1], -0.5 * 9.81, rtol=0.002)


def _energy(simulator: Simulator) -> float:
    """Kinetic energy and that of the springs, joule."""
    one, state = simulator.garments[0], simulator.states[0]
    cloth = one.constraints
    ends = state.positions[cloth.edges]
    longer = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) - cloth.edge_rest
    kinetic = (state.velocities**2 / (2 * cloth.inverse_mass[:, None])).sum()
    return float(kinetic + one.material.edge_stiffness * (longer**2).sum() / 2)
