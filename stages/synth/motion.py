"""Motions: training (walk, twist, arm raise, squat, turn), held out (leg raise, turn, bow), and a showcase.

A pose is a set of Euler angles in degrees per joint, a function of the time in seconds. Angles at a joint
are (about x: forward/back, about y: twist, about z: sideways) and are applied in the order z, x, y to a
T-pose limb; the right side mirrors the left one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body import JOINT_INDEX, Poses
from stages.synth.bodies import ShapedBody

FPS = 30.0
SHOWCASE_SECONDS = 210 / FPS

Angles = dict[str, NDArray[np.float64]]
Motion = Callable[[float], Angles]


def a_pose() -> Angles:
    """Arms about 50° down, legs apart: the pose of frame 0."""
    return _mirrored({"shoulder": (0, 0, -46), "elbow": (0, -6, 0), "hip": (0, 0, 4), "collar": (0, 0, -4)})


def training_motion(seconds: float) -> Angles:
    """Walk in place, twist, raise both arms, squat, turn around; starts in the A-pose."""
    t = seconds
    pose = a_pose()
    _add(pose, _walk(t, 0.15, 1.75))
    _add(pose, _twist(t, 1.65, 2.75))
    _add(pose, _raise_arms(t, 2.45, 3.65))
    _add(pose, _squat(t, 3.4, 4.6))
    turn = 360.0 * _ease((t - 3.0) / 2.3)
    _add(pose, {"pelvis": np.array([0.0, turn, 0.0])})
    return pose


def held_out_motion(seconds: float) -> Angles:
    """Side leg raise with a lean, a half turn, a bow: nothing of it is in the training motion."""
    t = 0.78 * seconds
    pose = a_pose()
    side = _bump(t, 0.05, 0.85)
    _add(pose, {"left_hip": side * np.array([0, 0, 34.0]), "pelvis": side * np.array([0, 0, 5.0])})
    _add(pose, {"spine1": side * np.array([0, 0, 8.0]), "left_shoulder": side * np.array([0, 0, 28.0])})
    _add(pose, {"right_shoulder": side * np.array([0, 0, -22.0])})
    turn = 180.0 * _ease((t - 0.6) / 0.8)
    step = _bump(t, 0.6, 1.4)
    _add(pose, {"pelvis": np.array([0, turn, 0]), "right_hip": step * np.array([-16.0, 0, 0])})
    _add(pose, {"right_knee": step * np.array([24.0, 0, 0])})
    bow = _bump(t, 1.15, 2.35)
    _add(pose, {"pelvis": bow * np.array([18.0, 0, 0]), "left_hip": bow * np.array([-18.0, 0, 0])})
    _add(pose, {"right_hip": bow * np.array([-18.0, 0, 0]), "spine1": bow * np.array([12.0, 0, 0])})
    _add(pose, {"spine2": bow * np.array([10.0, 0, 0]), "neck": bow * np.array([8.0, 0, 0])})
    return pose


def showcase_motion(seconds: float) -> Angles:
    """For films: walk in place while turning around once, raise both arms, twist."""
    t = seconds
    pose = a_pose()
    _add(pose, _walk(t, 0.1, 4.0))
    _add(pose, {"pelvis": np.array([0.0, 360.0 * _ease((t - 0.6) / 3.6), 0.0])})
    _add(pose, _raise_arms(t, 4.0, 5.4))
    _add(pose, _twist(t, 5.2, 6.8))
    return pose


def poses_of(motion: Motion, frames: int, body: ShapedBody) -> Poses:
    """The motion at 30 frames/s, the lowest vertex of the body on the floor (y = 0), smoothly."""
    rotations = np.stack([rotations_of(motion(frame / FPS)) for frame in range(frames)])
    zero = np.zeros((frames, 3))
    transforms = body.transforms(rotations, zero)
    feet = np.flatnonzero(np.isin(body.weights.argmax(axis=1), [JOINT_INDEX[n] for n in _FEET]))
    lowest = [body.pose(body.rest_vertices[feet], body.weights[feet], one)[:, 1].min() for one in transforms]
    translation = zero
    translation[:, 1] = -np.asarray(lowest)
    expression = np.zeros((frames, 10), dtype=np.float32)
    return Poses(rotations.astype(np.float32), translation.astype(np.float32), body.betas, expression, FPS)


def rotations_of(angles: Angles) -> NDArray[np.float64]:
    """(55, 3) axis-angle, radians."""
    rotations = np.zeros((len(JOINT_INDEX), 3))
    for name, degrees in angles.items():
        turn = Rotation.from_euler("zxy", degrees[[2, 0, 1]], degrees=True)
        rotations[JOINT_INDEX[name]] = turn.as_rotvec()
    return rotations


_FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")


def _walk(t: float, start: float, end: float) -> Angles:
    """Steps of 0.55 s: legs, counter-swinging arms, a little sway of pelvis and spine."""
    strength = _ease((t - start) / 0.3) * _ease((end - t) / 0.3)
    phase = 2 * np.pi * (t - start) / 1.1
    left, right = np.sin(phase), np.sin(phase + np.pi)
    lift_left, lift_right = np.sin(phase + 1.1), np.sin(phase + np.pi + 1.1)
    pose = {
        "left_hip": np.array([-26 * left, 0, 0]),
        "right_hip": np.array([-26 * right, 0, 0]),
        "left_knee": np.array([8 + 34 * max(lift_left, 0.0) ** 2, 0, 0]),
        "right_knee": np.array([8 + 34 * max(lift_right, 0.0) ** 2, 0, 0]),
        "left_shoulder": np.array([0, 18 * left, -3]),
        "right_shoulder": np.array([0, -18 * right, 3]),
        "left_elbow": np.array([0, -14, 0]),
        "right_elbow": np.array([0, 14, 0]),
        "pelvis": np.array([0, 5 * left, 2 * np.sin(phase + 0.6)]),
        "spine2": np.array([2, -7 * left, 0]),
    }
    return {name: strength * angles for name, angles in pose.items()}


def _twist(t: float, start: float, end: float) -> Angles:
    swing = _bump(t, start, end) * np.sin(2 * np.pi * (t - start) / (end - start))
    return {
        "pelvis": np.array([0, 14 * swing, 0]),
        "spine1": np.array([0, 14 * swing, 0]),
        "spine2": np.array([0, 12 * swing, 0]),
        "spine3": np.array([0, 8 * swing, 0]),
    }


def _raise_arms(t: float, start: float, end: float) -> Angles:
    up = _bump(t, start, end)
    return {
        "left_shoulder": up * np.array([0, -10, 70.0]),
        "right_shoulder": up * np.array([0, 10, -70.0]),
        "left_collar": up * np.array([0, 0, 14.0]),
        "right_collar": up * np.array([0, 0, -14.0]),
        "head": up * np.array([-8.0, 0, 0]),
    }


def _squat(t: float, start: float, end: float) -> Angles:
    down = _bump(t, start, end)
    pose = {
        "hip": (-62.0, 0.0, 8.0),
        "knee": (74.0, 0.0, 0.0),
        "ankle": (-26.0, 0.0, 0.0),
        "shoulder": (0.0, -34.0, 26.0),
    }
    both = {name: down * angles for name, angles in _mirrored(pose).items()}
    both["pelvis"] = down * np.array([14.0, 0, 0])
    both["spine1"] = down * np.array([6.0, 0, 0])
    return both


def _mirrored(left: Mapping[str, tuple[float, float, float]]) -> Angles:
    """Both sides from the left one: rotations about y and z change sign on the right."""
    pose: Angles = {}
    for name, angles in left.items():
        pose["left_" + name] = np.array(angles, dtype=np.float64)
        pose["right_" + name] = np.array(angles, dtype=np.float64) * (1, -1, -1)
    return pose


def _add(pose: Angles, more: Angles) -> None:
    for name, angles in more.items():
        pose[name] = pose.get(name, np.zeros(3)) + angles


def _ease(x: float) -> float:
    """Smooth step of fifth order: value, velocity and acceleration are continuous."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (x * (6 * x - 15) + 10)


def _bump(t: float, start: float, end: float) -> float:
    """0 → 1 → 0 between start and end, with a short stay at the top."""
    ramp = 0.42 * (end - start)
    return _ease((t - start) / ramp) * _ease((end - t) / ramp)
