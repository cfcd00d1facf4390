"""Body landmarks of networks in a fit: where they are on the body, a first pose, residuals, and a check.

The 33 landmarks are BlazePose's, triangulated (`stages.shared.capture.landmarks`). Joints of the skeleton
stand for most of them; nose, ears, heels and toes are vertices, found by their place on the body at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.register_template.fitting.bones import (
    Doubles,
    State,
    SurfacePoints,
    all_vertices,
    bones_of,
)
from stages.register_template.fitting.prior import Prior
from stages.register_template.fitting.solve import ActiveParameters, Residuals, step
from stages.shared.body import BodyModel
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX, SHAPE_COUNT

# BlazePose's number, the joint it stands for, and how well it is known, metres: networks put hips and
# shoulders at the outside of the joint.
_JOINTS = (
    (11, "left_shoulder", 0.035), (12, "right_shoulder", 0.035), (13, "left_elbow", 0.025),
    (14, "right_elbow", 0.025), (15, "left_wrist", 0.025), (16, "right_wrist", 0.025),
    (23, "left_hip", 0.05), (24, "right_hip", 0.05), (25, "left_knee", 0.025), (26, "right_knee", 0.025),
    (27, "left_ankle", 0.025), (28, "right_ankle", 0.025),
)  # fmt: skip
_NOSE, _LEFT_EAR, _RIGHT_EAR = 0, 7, 8
_LEFT_HEEL, _RIGHT_HEEL, _LEFT_TOE, _RIGHT_TOE = 29, 30, 31, 32
_VERTEX_NOISE_M = 0.03
_FEWEST = 8
_MEASUREMENTS = 75.0  # that the landmarks are worth for every view, as the contours of one view are 150
_ROBUST_M = 0.12
_FIRST_ROUNDS = ((1.0, 12), (0.3, 12), (_ROBUST_M, 8))
_BODY = np.arange(22)
_FIRST_BETAS, _NO_BETAS = np.arange(2), np.arange(0)
_POINTS: dict[str, tuple[NDArray[np.intp], SurfacePoints, Doubles]] = {}
CHECKED = {
    "head": (_NOSE, _LEFT_EAR, _RIGHT_EAR),
    "hands": (15, 16),
    "feet": (27, 28, _LEFT_HEEL, _RIGHT_HEEL),
    "knees": (25, 26),
    "elbows": (13, 14),
}


@dataclass(frozen=True, eq=False)
class Targets:
    """Landmarks of one frame: points (33, 3) f64 m world, NaN where unknown."""

    points: Doubles

    @property
    def known(self) -> NDArray[np.bool_]:
        """(33,) which landmarks there are."""
        return np.asarray(np.isfinite(self.points).all(axis=1))

    def enough(self, body: BodyModel) -> bool:
        """Whether they say how the person stands."""
        numbers, _, _ = landmark_points(body)
        hips_and_shoulders = self.known[[11, 12, 23, 24]].all()
        return bool(hips_and_shoulders and self.known[numbers].sum() >= _FEWEST)


def landmark_points(body: BodyModel) -> tuple[NDArray[np.intp], SurfacePoints, Doubles]:
    """Numbers (K,) of the landmarks in use, where they are on the body, and their noise (K,) metres."""
    if body.digest in _POINTS:
        return _POINTS[body.digest]
    joints = np.array([JOINT_INDEX[name] for _, name, _ in _JOINTS])
    vertices = _vertex_landmarks(body)
    surface, rows = all_vertices(body), np.array(list(vertices.values()))
    points = SurfacePoints(
        np.concatenate([body.joint_template[joints], surface.rest[rows]]),
        np.concatenate([body.joint_directions[joints], surface.directions[rows]]),
        np.concatenate([np.eye(JOINT_COUNT)[joints], surface.weights[rows]]),
    )
    noise = [noise for *_, noise in _JOINTS] + [_VERTEX_NOISE_M] * len(vertices)
    numbers = [number for number, *_ in _JOINTS] + list(vertices)
    _POINTS.clear()  # one model is in use at a time
    _POINTS[body.digest] = np.array(numbers), points, np.array(noise)
    return _POINTS[body.digest]


def landmark_residuals(body: BodyModel, state: State, frame: int, targets: Targets, views: int) -> Residuals:
    """Distances of the body's landmarks from the triangulated ones along the three axes, metres."""
    return _residuals(body, state, frame, targets, _ROBUST_M, _MEASUREMENTS * views)


def first_state(body: BodyModel, targets: Targets, betas: Doubles | None = None) -> State:
    """One frame of parameters from landmarks alone, coarse to fine.

    Without `betas` (10,) the first two are found, too; the others stay at the mean.

    The trunk's axes (from hip to hip and from hips to shoulders) give the root's rotation.
    """
    points = targets.points
    across = points[23] - points[24] + points[11] - points[12]
    upward = points[[11, 12]].mean(axis=0) - points[[23, 24]].mean(axis=0)
    x = across / np.linalg.norm(across)
    z = np.cross(x, upward)
    z /= np.linalg.norm(z)
    turn = np.stack([x, np.cross(z, x), z], axis=1)
    rotations = np.zeros((1, JOINT_COUNT, 3))
    rotations[0, 0] = Rotation.from_matrix(turn).as_rotvec()
    shape = np.zeros(SHAPE_COUNT) if betas is None else np.array(betas, np.float64)
    state = State(rotations, np.zeros((1, 3)), shape)
    hips = [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]
    state.translation[0] = points[[23, 24]].mean(axis=0) - bones_of(body, state).joints[hips].mean(axis=0)
    active, prior = ActiveParameters(_BODY, _FIRST_BETAS if betas is None else _NO_BETAS), Prior()
    for robust, steps in _FIRST_ROUNDS:
        for _ in range(steps):
            terms = [_residuals(body, state, 0, targets, robust, _MEASUREMENTS)]
            state = step(state, [bones_of(body, state)], [terms], prior, active)
    return state


def landmark_distances(body: BodyModel, state: State, frame: int, targets: Targets) -> dict[str, float]:
    """Metres between the body's landmarks and the triangulated ones: median, and the median of some parts."""
    numbers, points, _ = landmark_points(body)
    away = np.linalg.norm(bones_of(body, state, frame).positions(points) - targets.points[numbers], axis=1)
    result = {"all": float(np.nanmedian(away)) if np.isfinite(away).any() else np.nan}
    for part, members in CHECKED.items():
        some = away[np.isin(numbers, members)]
        result[part] = float(np.nanmedian(some)) if np.isfinite(some).any() else np.nan
    return result


def _residuals(
    body: BodyModel, state: State, frame: int, targets: Targets, robust: float, measurements: float
) -> Residuals:
    numbers, points, noise = landmark_points(body)
    known = targets.known[numbers]
    rows = np.flatnonzero(known)
    some = SurfacePoints(points.rest[rows], points.directions[rows], points.weights[rows])
    offset = bones_of(body, state, frame).positions(some) - targets.points[numbers[rows]]
    kernel = (robust**2 / (robust**2 + (offset**2).sum(axis=1))) ** 2
    weights = kernel * measurements / (max(len(rows), 1) * noise[rows] ** 2)
    three = np.repeat(np.arange(len(rows)), 3)
    axes = np.tile(np.eye(3), (len(rows), 1))
    tripled = SurfacePoints(some.rest[three], some.directions[three], some.weights[three])
    return Residuals(tripled, offset.reshape(-1), axes, weights[three])


def _vertex_landmarks(body: BodyModel) -> dict[int, int]:
    """Landmark number to vertex: front and sides of the head, backs and tips of the feet."""
    vertices = body.template_vertices.astype(np.float64)
    joint = body.skin_weights.argmax(axis=1)
    head = np.flatnonzero(joint == JOINT_INDEX["head"])
    nose = head[vertices[head, 2].argmax()]
    middle = body.joint_template[JOINT_INDEX["head"]]
    level = head[np.abs(vertices[head, 1] - vertices[nose, 1]) < 0.03]
    level = level[vertices[level, 2] < (vertices[nose, 2] + middle[2]) / 2 + 0.02]
    result = {_NOSE: int(nose)}
    if len(level):
        result |= {
            _LEFT_EAR: int(level[vertices[level, 0].argmax()]),
            _RIGHT_EAR: int(level[vertices[level, 0].argmin()]),
        }
    for side, heel, toe in (("left", _LEFT_HEEL, _LEFT_TOE), ("right", _RIGHT_HEEL, _RIGHT_TOE)):
        foot = np.flatnonzero(np.isin(joint, [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]))
        low = foot[vertices[foot, 1] < vertices[foot, 1].min() + 0.05]
        result[heel] = int(low[vertices[low, 2].argmin()])
        result[toe] = int(low[vertices[low, 2].argmax()])
    return result
