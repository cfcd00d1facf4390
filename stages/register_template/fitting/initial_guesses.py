"""Initial guesses of a fit: every up axis, eight directions, arms out and arms down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stages.register_template.fitting.bones import Doubles, State, vertices_of
from stages.shared.body import BodyModel
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX, SHAPE_COUNT

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
    starts = []
    tall = np.ptp(body.template_vertices[:, 1])
    for up, turn in UP_AXES.items():
        height = np.ptp(points @ turn[1])
        if not 1 / _HEIGHT_TOLERANCE < height / tall < _HEIGHT_TOLERANCE:
            continue
        for yaw in range(_YAWS):
            facing = Rotation.from_euler("y", yaw * 2 * np.pi / _YAWS).as_matrix()
            for angle in _ARMS_DOWN:
                starts.append(InitialGuess(up, _state(body, points, turn.T @ facing, angle)))
    return starts


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
