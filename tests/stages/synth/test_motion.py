"""The motions: smooth, plausible, different from each other, feet on the floor."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.shared.body import JOINT_INDEX, Poses, embedded_body
from stages.synth import motion
from stages.synth.bodies import PERSON_1, PERSON_2, ShapedBody, betas_of
from stages.synth.views import camera_ring

MOTIONS = {
    "training": (motion.training_motion, 160 / motion.FPS),
    "held out": (motion.held_out_motion, 80 / motion.FPS),
}


def _rotations(name: str) -> np.ndarray:
    moves, seconds = MOTIONS[name]
    frames = round(seconds * motion.FPS)
    return np.stack([motion.rotations_of(moves(frame / motion.FPS)) for frame in range(frames)])


@pytest.mark.parametrize("name", MOTIONS)
def test_frame_zero_is_the_a_pose(name: str) -> None:
    assert _rotations(name)[0] == pytest.approx(motion.rotations_of(motion.a_pose()), abs=1e-6)


@pytest.mark.parametrize("name", MOTIONS)
def test_joints_turn_smoothly(name: str) -> None:
    rotations = _rotations(name)
    frames, joints = rotations.shape[:2]
    turns = Rotation.from_rotvec(rotations.reshape(-1, 3)).as_matrix().reshape(frames, joints, 3, 3)
    between = np.einsum("tjki,tjkl->tjil", turns[:-1], turns[1:])
    step = Rotation.from_matrix(between.reshape(-1, 3, 3)).as_rotvec().reshape(frames - 1, joints, 3)
    assert np.linalg.norm(step, axis=-1).max() * motion.FPS < 9.0  # rad/s, the spin is the fastest
    assert np.linalg.norm(np.diff(step, axis=0), axis=-1).max() < 0.1  # no jerk within 1/30 s


@pytest.mark.parametrize("name", MOTIONS)
def test_joint_limits_are_those_of_people(name: str) -> None:
    angle = np.degrees(np.linalg.norm(_rotations(name), axis=-1)).max(axis=0)
    limits = {
        "left_knee": 140,
        "right_knee": 140,
        "left_hip": 110,
        "right_hip": 110,
        "neck": 45,
        "spine1": 40,
    }
    for joint, limit in limits.items():
        assert angle[JOINT_INDEX[joint]] < limit
    knees = _rotations(name)[:, [JOINT_INDEX["left_knee"], JOINT_INDEX["right_knee"]]]
    assert knees[..., 0].min() > -1e-6  # knees bend one way only


def test_the_held_out_motion_is_not_in_the_training_motion() -> None:
    joints = [JOINT_INDEX[name] for name in ("left_hip", "right_hip", "spine1", "spine2", "left_shoulder")]
    train, held_out = _rotations("training")[:, joints], _rotations("held out")[:, joints]
    apart = np.abs(held_out[:, None] - train[None]).max(axis=(-1, -2)).min(axis=1)
    assert np.degrees(apart).max() > 20


def test_the_two_people_differ_and_stand_on_the_floor() -> None:
    model = embedded_body()
    bodies = [ShapedBody(model, betas_of(model, person)) for person in (PERSON_1, PERSON_2)]
    heights = [np.ptp(body.rest_vertices[:, 1]) for body in bodies]
    assert heights[1] - heights[0] > 0.12
    waists = [_waist(body) for body in bodies]
    assert waists[1] - waists[0] > 0.04
    assert max(np.abs(body.betas).max() for body in bodies) < 3.0
    poses = motion.poses_of(motion.training_motion, 40, bodies[1])
    lowest = _animated(bodies[1], poses)[:, :, 1].min(axis=1)
    assert np.abs(lowest).max() < 0.003


@pytest.mark.parametrize("name", MOTIONS)
def test_every_camera_sees_the_whole_person(name: str) -> None:
    model = embedded_body()
    body = ShapedBody(model, betas_of(model, PERSON_2))  # the larger one
    moves, seconds = MOTIONS[name]
    poses = motion.poses_of(moves, round(seconds * motion.FPS), body)
    cameras, _ = camera_ring(8, 100)
    for points in _animated(body, poses[::8]):
        for camera in cameras:
            pixels, _ = camera.project(points)
            assert pixels.min() > 1.0
            assert pixels.max() < 99.0


def _animated(body: ShapedBody, poses: Poses) -> np.ndarray:
    """(T, V, 3) m, world, the body in every frame."""
    return body.pose(body.rest_vertices, body.weights, body.transforms(poses.rotations, poses.translation))


def _waist(body: ShapedBody) -> float:
    points = body.rest_vertices
    near = (np.abs(points[:, 1] - body.joints[JOINT_INDEX["spine2"], 1]) < 0.03) & (
        np.abs(points[:, 0]) < 0.3
    )
    return float(np.ptp(points[near, 0]))
