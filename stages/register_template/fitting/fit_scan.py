"""Fit the body to a scan of a dressed person: from many initial guesses, coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.register_template.fitting.bones import Doubles, State, SurfacePoints, bones_of, vertices_of
from stages.register_template.fitting.prior import Prior
from stages.register_template.fitting.scan_terms import (
    ScanPoints,
    from_body,
    from_scan,
    misfit,
    nearest_on_body,
    outer_points,
    scan_points,
)
from stages.register_template.fitting.skin_contact import guess_contact
from stages.register_template.fitting.solve import ActiveParameters, step
from stages.shared.body import BodyModel
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX, SHAPE_COUNT
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.report import Report

# The axis that points up, and the rotation that turns it to +y.
UP_AXES: dict[str, Doubles] = {
    "+y": np.eye(3),
    "+z": Rotation.from_euler("x", -90, degrees=True).as_matrix().round(),
    "-y": Rotation.from_euler("x", 180, degrees=True).as_matrix().round(),
    "-z": Rotation.from_euler("x", 90, degrees=True).as_matrix().round(),
    "+x": Rotation.from_euler("z", 90, degrees=True).as_matrix().round(),
    "-x": Rotation.from_euler("z", -90, degrees=True).as_matrix().round(),
}
_YAWS = 8
_ARMS_DOWN = (0.0, 0.8)  # radians: T-pose, A-pose
_HEIGHT_TOLERANCE = 1.35  # between the box of the points and that of the body


@dataclass(eq=False)
class InitialGuess:
    """The up axis, one frame of parameters in the coordinates of the points, and its misfit, metres²."""

    up: str
    state: State
    loss: float = float("inf")


def initial_guesses(body: BodyModel, points: Doubles) -> list[InitialGuess]:
    """Guesses for points (M, 3) of a standing person, metres, with any axis up."""
    guesses = []
    tall = np.ptp(body.template_vertices[:, 1])
    for up, turn in UP_AXES.items():
        height = np.ptp(points @ turn[1])
        if not 1 / _HEIGHT_TOLERANCE < height / tall < _HEIGHT_TOLERANCE:
            continue
        for yaw in range(_YAWS):
            facing = Rotation.from_euler("y", yaw * 2 * np.pi / _YAWS).as_matrix()
            for angle in _ARMS_DOWN:
                guesses.append(InitialGuess(up, _state(body, points, turn.T @ facing, angle)))
    return guesses


def _state(body: BodyModel, points: Doubles, root: Doubles, arm_angle: float) -> State:
    """The mean shape turned by `root` (3, 3), the middle of its box where that of the points is."""
    rotations = np.zeros((1, JOINT_COUNT, 3))
    rotations[0, 0] = Rotation.from_matrix(root).as_rotvec()
    rotations[0, JOINT_INDEX["left_shoulder"], 2] = -arm_angle
    rotations[0, JOINT_INDEX["right_shoulder"], 2] = arm_angle
    state = State(rotations, np.zeros((1, 3)), np.zeros(SHAPE_COUNT))
    vertices = vertices_of(body, state)
    state.translation[0] = _middle(points) - _middle(vertices)
    return state


def _middle(points: Doubles) -> Doubles:
    return (points.max(axis=0) + points.min(axis=0)) / 2


_LARGE_JOINTS = np.array(
    [0] + [JOINT_INDEX[f"{side}_{name}"] for side in ("left", "right")
           for name in ("hip", "knee", "shoulder", "elbow")]
)  # fmt: skip
BODY_JOINTS = np.arange(22)
_ALL_JOINTS = np.r_[np.arange(22), np.arange(25, 55)]
_FIRST_BETAS = np.arange(2)
ALL_BETAS = np.arange(SHAPE_COUNT)
_MOST_GUESSES = 16


@dataclass(frozen=True, eq=False)
class Level:
    """One round of a fit.

    Attributes:
        points: points on either surface. robust: distance of half weight, metres. steps: at full effort.
        survivors: number of guesses that go on. joints, betas: numbers of those that may change.
        least_contact: smallest contact of any scan point.
    """

    points: int
    robust: float
    steps: int
    survivors: int
    joints: NDArray[np.intp]
    betas: NDArray[np.intp]
    least_contact: float


LEVELS = (
    Level(400, 0.25, 6, 4, _LARGE_JOINTS, _FIRST_BETAS, 0.5),
    Level(1000, 0.12, 8, 2, BODY_JOINTS, ALL_BETAS, 0.3),
    Level(2000, 0.05, 8, 1, BODY_JOINTS, ALL_BETAS, 0.1),
    Level(3000, 0.02, 10, 1, BODY_JOINTS, ALL_BETAS, 0.03),
    Level(5000, 0.01, 12, 1, _ALL_JOINTS, ALL_BETAS, 0.02),
)


@dataclass(frozen=True, eq=False)
class ScanFit:
    """The fit: one frame of parameters in the scan's coordinates, the up axis, and the misfit (m²)."""

    state: State
    up: str
    loss: float


def fit_scan(
    body: BodyModel,
    mesh: Mesh,
    report: Report,
    effort: float = 1.0,
    start: State | None = None,
    levels: tuple[Level, ...] = LEVELS,
) -> ScanFit:
    """Fit pose and shape to one mesh.

    Arguments:
        mesh: of one standing person, metres, clean (`scan_cleaning`).
        effort: share of the steps of every level.
        start: one frame to improve; without it every up axis and eight directions are tried.
        levels: rounds, coarse to fine; with a start the first two are left out.

    Raises:
        BadData: the mesh has not the height of a person along any axis.
    """
    scan = scan_points(mesh, LEVELS[-1].points)
    if start is None:
        guesses = initial_guesses(body, scan.points)
        if not guesses:
            size = np.ptp(mesh.vertices, axis=0)
            raise BadData(
                f"The mesh is {size[0]:.2f} x {size[1]:.2f} x {size[2]:.2f} m large; no standing person is.",
                f"mesh of {len(mesh.vertices)} vertices",
                "Give a mesh of one standing person, or the body fit with --params.",
            )
        guesses = _promising(body, guesses, scan)
    else:
        guesses, levels = [InitialGuess("+y", start)], levels[2:]
    for level in levels:
        thinned, outer = scan.thinned(level.points), outer_points(body, level.points)
        for number, one in enumerate(guesses):
            _improve(body, one, thinned, outer, level, effort, guess_contacts=mesh.labels is None)
            report.progress(number + 1, len(guesses), loss=one.loss)
        guesses = sorted(guesses, key=lambda one: one.loss)[: level.survivors]
    best = guesses[0]
    return ScanFit(best.state, best.up, best.loss)


def _promising(body: BodyModel, guesses: list[InitialGuess], scan: ScanPoints) -> list[InitialGuess]:
    """The guesses that fit best before any step."""
    level = LEVELS[0]
    thinned, outer = scan.thinned(level.points), outer_points(body, level.points)
    for one in guesses:
        positions = bones_of(body, one.state, 0).positions(outer)
        one.loss = misfit(body, vertices_of(body, one.state), positions, thinned, level.robust)
    return sorted(guesses, key=lambda one: one.loss)[:_MOST_GUESSES]


def _improve(
    body: BodyModel,
    guess: InitialGuess,
    scan: ScanPoints,
    outer: SurfacePoints,
    level: Level,
    effort: float,
    guess_contacts: bool,
) -> None:
    """Some steps from a guess, in place."""
    active, state, prior = ActiveParameters(level.joints, level.betas), guess.state, Prior()
    for number in range(max(3, round(effort * level.steps))):
        bones, vertices = bones_of(body, state, 0), vertices_of(body, state)
        if guess_contacts and number % 4 == 0 and level is not LEVELS[0]:
            scan = replace(
                scan, contact=guess_contact(body, nearest_on_body(body, vertices, scan.points), scan)
            )
        contact = scan.contact_at_least(level.least_contact)
        terms = [
            from_scan(body, vertices, contact, level.robust),
            from_body(outer, bones.positions(outer), contact, level.robust),
        ]
        state = step(state, [bones], [terms], prior, active)
    guess.state = state
    positions = bones_of(body, state, 0).positions(outer)
    guess.loss = misfit(body, vertices_of(body, state), positions, scan, level.robust)
