"""The fit of the body: its Jacobian, scans of several bodies and poses, masks alone, several starts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.register_template.fitting import fit_scan as rounds
from stages.register_template.fitting.bones import State, bones_of, surface_points, vertices_of
from stages.register_template.fitting.contours import views_of
from stages.register_template.fitting.fit_scan import UP_AXES, fit_scan, initial_guesses
from stages.register_template.fitting.fit_views import Observation, first_pose, misfit_of
from stages.register_template.fitting.prior import Prior, limits
from stages.register_template.fitting.scan_terms import from_scan, outer_points, scan_points
from stages.register_template.fitting.solve import ActiveParameters, _moved
from stages.register_template.hull import rough_hull
from stages.shared.body import embedded_body, posed_joints, posed_vertices
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX, LEFT_EYE, RIGHT_EYE
from stages.shared.capture import open_capture
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.topology import vertex_normals
from stages.shared.report import SILENT

from .scenes import a_pose, write_capture

# Small rounds for small tests: the same recipe with fewer points.
QUICK = tuple(
    replace(level, points=points, steps=steps)
    for level, points, steps in zip(rounds.LEVELS, (250, 400, 700, 900, 1200), (4, 6, 6, 6, 6), strict=True)
)


def a_state(seed: int, betas: float = 1.0, bend: float = 0.15, down: float = 0.7, yaw: float = 0.0) -> State:
    """Somebody standing, arms down by `down`, a little bent everywhere."""
    random = np.random.default_rng(seed)
    rotations = np.zeros((1, JOINT_COUNT, 3))
    rotations[0, 1:22] = random.normal(0, bend, (21, 3)) * (np.abs(limits()[0].reshape(-1, 3)[1:22]) > 0.3)
    rotations[0, 16, 2] -= down
    rotations[0, 17, 2] += down
    rotations[0, [4, 5], 1:] = 0  # knees bend one way only
    rotations[0, [4, 5], 0] = np.abs(rotations[0, [4, 5], 0])
    rotations[0, 0, 1] = yaw
    return State(rotations, np.array([[0.3, 1.0, -0.2]]), random.normal(0, betas, 10))


def joint_error(found: State, truth: State) -> float:
    body = embedded_body()
    apart = bones_of(body, found).joints[:22] - bones_of(body, truth).joints[:22]
    return float(np.linalg.norm(apart, axis=1).mean())


def test_bones_are_those_of_the_body_model() -> None:
    body, state = embedded_body(), a_state(1, bend=0.5)
    parts = [torch.from_numpy(part) for part in (state.rotations[0], state.translation[0], state.betas)]
    np.testing.assert_allclose(vertices_of(body, state), posed_vertices(body, *parts).numpy(), atol=1e-12)
    np.testing.assert_allclose(bones_of(body, state).joints, posed_joints(body, *parts).numpy(), atol=1e-12)


def test_rows_are_finite_differences() -> None:
    body, state, random = embedded_body(), a_state(2, bend=0.5), np.random.default_rng(0)
    points = surface_points(body, random.integers(0, len(body.faces), 40), random.dirichlet([1, 1, 1], 40))
    gradients, joints = random.normal(size=(40, 3)), np.array([0, 3, 9, 13, 16, 18, 20, 25, 37])
    active = ActiveParameters(joints, np.arange(10))
    rows = bones_of(body, state).jacobian(points, gradients, joints)
    here, step = bones_of(body, state).positions(points), 1e-6
    for column in range(rows.shape[1]):
        change = np.zeros(rows.shape[1])
        change[column] = step
        moved = bones_of(body, _moved(state, change, active)).positions(points)
        np.testing.assert_allclose(
            ((moved - here) * gradients).sum(axis=1) / step, rows[:, column], atol=2e-5
        )


def test_prior_slopes_are_finite_differences_of_its_cost() -> None:
    spread, low, high = limits()
    state = a_state(3, bend=0.6)
    state.rotations[0, JOINT_INDEX["left_knee"], 0] = -0.5  # beyond its limit

    def cost(rotations: np.ndarray) -> float:
        flat = rotations.reshape(-1)
        beyond = np.maximum(low - flat, 0) + np.maximum(flat - high, 0)
        return float((flat**2 / spread**2 + beyond**2 / np.radians(4.0) ** 2).sum() / 2)

    slope = Prior().pose(state.rotations[0], 0)[1]
    for joint in (JOINT_INDEX["left_knee"], JOINT_INDEX["right_shoulder"], JOINT_INDEX["spine2"]):
        for axis in range(3):
            changed = state.rotations[0].copy()
            turn = Rotation.from_rotvec(1e-6 * np.eye(3)[axis])
            changed[joint] = (turn * Rotation.from_rotvec(changed[joint])).as_rotvec()
            numeric = (cost(changed) - cost(state.rotations[0])) / 1e-6
            assert slope[3 * joint + axis] == pytest.approx(numeric, rel=1e-3, abs=1e-2)


def test_no_point_of_a_fit_lies_in_the_eyes() -> None:
    body = embedded_body()
    points = outer_points(body, 3000)
    eyes = points.weights[:, [LEFT_EYE, RIGHT_EYE]].sum(axis=1) > 0.9
    assert eyes.mean() < 0.004 and 0.7 < len(points.rest) / 3000 <= 1


@pytest.mark.parametrize(
    ("seed", "up", "yaw", "down"),
    [
        (5, "+z", 2.6, 0.2),
        pytest.param(4, "+y", np.pi, 0.8, marks=pytest.mark.long),
        pytest.param(6, "-y", -2.0, 1.1, marks=pytest.mark.long),
    ],
)
def test_a_scan_in_any_orientation(seed: int, up: str, yaw: float, down: float) -> None:
    body, truth = embedded_body(), a_state(seed, yaw=yaw, down=down, bend=0.08)
    turn = UP_AXES[up]
    scan = Mesh((vertices_of(body, truth) @ turn).astype(np.float32), body.faces)
    fit = fit_scan(body, scan, SILENT, levels=QUICK)
    assert fit.up == up
    upright = bones_of(body, fit.state).joints[:22] @ turn.T
    assert np.linalg.norm(upright - bones_of(body, truth).joints[:22], axis=1).mean() < 0.015
    away = np.linalg.norm(vertices_of(body, fit.state) @ turn.T - vertices_of(body, truth), axis=1)
    assert away.mean() < 0.015


def test_clothes_lie_outside_and_skin_does_not() -> None:
    """A loose shirt around the trunk does not make the body fatter when labels, or only places, tell."""
    body, truth = embedded_body(), a_state(7, bend=0.05)
    vertices = vertices_of(body, truth)
    trunk = body.skin_weights[:, [0, 3, 6, 9, 13, 14]].sum(axis=1)
    dressed = vertices + 0.04 * trunk[:, None] * vertex_normals(vertices, body.faces)
    labels = np.where(trunk > 0.05, 3, 0).astype(np.uint8)
    start = truth.copy()
    start.betas = start.betas + 0.3
    for given in (labels, None):
        scan = Mesh(dressed.astype(np.float32), body.faces, None, given)
        fit = fit_scan(body, scan, SILENT, start=start, levels=QUICK)
        away = np.linalg.norm(vertices_of(body, fit.state) - vertices, axis=1)
        assert away.mean() < 0.008, given is None
    # Without room for clothes the same fit is pulled outward.
    bare = Mesh(dressed.astype(np.float32), body.faces, None, np.zeros(len(labels), np.uint8))
    tight = fit_scan(body, bare, SILENT, start=start, levels=QUICK)
    assert np.linalg.norm(vertices_of(body, tight.state) - vertices, axis=1).mean() > away.mean()


def test_a_point_inside_of_the_skin_counts_fully_and_one_outside_by_its_label() -> None:
    body, truth = embedded_body(), a_state(8)
    vertices = vertices_of(body, truth)
    normals = vertex_normals(vertices, body.faces)
    for offset, label, expected in ((-0.01, 3, 1.0), (0.01, 3, 0.0), (0.01, 0, 1.0)):
        shell = (vertices + offset * normals).astype(np.float32)
        scan = scan_points(Mesh(shell, body.faces, None, np.full(len(shell), label, np.uint8)), 400)
        weights = from_scan(body, vertices, scan, 0.05).weights
        full = from_scan(body, vertices, scan.contact_at_least(1.0), 0.05).weights
        # Folds of the skin (fingers, ears) find another side nearer.
        assert weights.sum() == pytest.approx(expected * full.sum(), abs=0.1 * full.sum())


def test_nothing_a_person_could_stand_in() -> None:
    flat = Mesh(np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0]], np.float32), np.array([[0, 1, 2]]))
    with pytest.raises(BadData, match="no standing person is"):
        fit_scan(embedded_body(), flat, SILENT)
    assert initial_guesses(embedded_body(), flat.vertices.astype(np.float64)) == []


def test_masks_alone_give_the_pose(tmp_path: Path) -> None:
    capture = open_capture(write_capture(tmp_path / "person"))
    take, body = capture.takes[0], embedded_body()
    observation = Observation(views_of(take, 1, 150))
    assert observation.views[0].contact is None  # no label images
    truth = State.of(a_pose()[1])
    hull = rough_hull(take, 1, SILENT)
    hull_height = np.ptp(hull.vertices[:, 1])
    assert abs(hull_height - np.ptp(vertices_of(body, truth)[:, 1])) < 0.06
    found = first_pose(body, hull, observation, SILENT, effort=0.5, levels=QUICK[:3])
    assert joint_error(found, truth) < 0.025
    # Pixels of 1.4 cm: no fit can be better than the truth is.
    assert misfit_of(body, found, observation) < 1.1 * misfit_of(body, truth, observation) + 0.002
    elsewhere = found.copy()
    elsewhere.translation[0, 0] += 0.1
    assert misfit_of(body, elsewhere, observation) > 1.3 * misfit_of(body, found, observation)
