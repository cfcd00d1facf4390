"""What a motion may need before it is worn: another up axis, frame rate or hands, corrections known for
AMASS.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.model import BodyModel
from stages.shared.body.poses import MAX_FRAMES, Poses
from stages.shared.body.skeleton import JOINT_INDEX, LEFT_HAND, RIGHT_HAND
from stages.shared.errors import UsageProblem
from stages.shared.finite import finite

Doubles = NDArray[np.float64]

UPS = ("auto", "y", "z", "x", "-y", "-z", "-x")
HANDS = ("file", "flat", "relaxed")
_LONGEST_RESAMPLED = 200_000  # frames; nearly two hours at 30 a second
_RAISED_COLLARS = 0.3  # radians about z


def axis_vector(axis: str) -> Doubles:
    """(3,) unit vector of an axis such as "z" or "-y"."""
    vector = np.zeros(3)
    vector["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return vector


def y_up_from(axis: str) -> Doubles:
    """(3, 3) rotation that brings an axis to +y: a quarter turn, or half a turn about x for "-y"."""
    up = axis_vector(axis)
    if axis == "-y":
        return np.diag([1.0, -1.0, -1.0])
    turn = np.cross(up, [0.0, 1.0, 0.0])
    return np.round(Rotation.from_rotvec(turn * np.pi / 2).as_matrix()) + 0.0


def y_up(poses: Poses, axis: str, body: BodyModel | None = None) -> Poses:
    """A motion in whose world `axis` points up, in the y-up world of `gw`.

    The body turns about the world's origin. Its translation is that of the root joint's rest place, so it
    turns about the pelvis of `body` (of a mean body at the origin without one).
    """
    if axis == "y":
        return poses
    turn = y_up_from(axis)
    pelvis = np.zeros(3) if body is None else body.joint_template[0].astype(np.float64)
    moved = (poses.translation.astype(np.float64) + pelvis) @ turn.T - pelvis
    rotations = poses.rotations.copy()
    root = Rotation.from_matrix(turn) * Rotation.from_rotvec(rotations[:, 0].astype(np.float64))
    rotations[:, 0] = root.as_rotvec()
    with np.errstate(over="ignore"):
        return replace(poses, rotations=rotations, translation=moved.astype(np.float32))


def check_length(poses: Poses, fps: float, where: str) -> None:
    """Refuse a resampling that makes more frames than a motion has; nothing is computed.

    Raises:
        UsageProblem: with the number of frames.
    """
    frames = len(poses) * fps / poses.fps
    longest = min(MAX_FRAMES, max(len(poses), _LONGEST_RESAMPLED))
    if frames > longest:
        raise UsageProblem(
            f"{len(poses)} frames at {poses.fps:g} a second become {frames:.0f} at {fps:g}; the limit is "
            f"{longest}.",
            where,
            "Check the frame rate of the file and of --fps.",
        )


def resample(poses: Poses, fps: float) -> Poses:
    """The same motion at `fps` frames per second; first frame at the same time, none beyond the last.

    Rotations are interpolated by slerp, everything else linearly.

    Arguments:
        poses: T frames.
        fps: > 0.

    Returns:
        floor((T−1)·fps/poses.fps) + 1 frames; `poses` itself when the rate is already right.

    Raises:
        UsageProblem: fps is not a positive number. BadData: a pose is not finite.
    """
    import roma  # loads the whole of torch._dynamo: two seconds
    import torch

    if not 0 < fps < 1e5:
        raise UsageProblem(
            f"{fps} is not a frame rate.", "frames per second", "Give a positive number, as 30."
        )
    if len(poses) == 1:
        return replace(poses, fps=fps)
    if abs(fps - poses.fps) < 1e-6 * fps:
        return poses
    step = poses.fps / fps
    count = int(np.floor((len(poses) - 1) / step + 1e-6)) + 1
    times = np.minimum(np.arange(count) * step, len(poses) - 1)
    before = np.minimum(times.astype(np.int64), len(poses) - 2)
    after, share = before + 1, times - before

    quaternions = roma.rotvec_to_unitquat(torch.from_numpy(poses.rotations).double())
    start, end = quaternions[before], quaternions[after]
    end = torch.where((start * end).sum(-1, keepdim=True) < 0, -end, end)
    steps = roma.unitquat_to_rotvec(roma.quat_product(roma.quat_conjugation(start), end))
    moved = roma.quat_product(start, roma.rotvec_to_unitquat(steps * torch.from_numpy(share)[:, None, None]))
    rotations = roma.unitquat_to_rotvec(moved).numpy()
    finite(rotations, "resample", rotations=poses.rotations)

    def linear(values: np.ndarray) -> np.ndarray:
        blended = values[before] + (values[after] - values[before]) * share[:, None]
        return finite(blended, "resample", translation=poses.translation, expression=poses.expression)

    return Poses(rotations, linear(poses.translation), poses.betas, linear(poses.expression), fps)


def with_hands(poses: Poses, hands: str, body: BodyModel | None = None) -> Poses:
    """The motion with the hands of its file ("file"), stretched out ("flat"), or at rest ("relaxed").

    Raises:
        UsageProblem: an unknown kind, or a body model without relaxed hands.
    """
    if hands not in HANDS:
        raise UsageProblem(
            f"There are no hands called {hands!r}.", "option --hands", "Choose of: " + ", ".join(HANDS) + "."
        )
    if hands == "file":
        return poses
    rotations = poses.rotations.copy()
    for joints, side in ((LEFT_HAND, "left"), (RIGHT_HAND, "right")):
        mean = None if body is None else getattr(body, f"hand_mean_{side}")
        if hands == "relaxed" and mean is None:
            raise UsageProblem(
                "This body model knows no relaxed hand.",
                "option --hands",
                "Choose flat, or give another --body-model.",
            )
        rotations[:, joints] = 0.0 if hands == "flat" or mean is None else mean.reshape(15, 3)
    return replace(poses, rotations=rotations)


def amass_corrected(poses: Poses) -> Poses:
    """The motion with raised collars, the head not nodding, straight wrists (Animatable Gaussians).

    Fits of motion capture without images hang the collars and twist wrists and head; these are the
    corrections that its authors apply to AMASS before driving an avatar.
    """
    rotations = poses.rotations.copy()
    rotations[:, JOINT_INDEX["left_collar"], 2] += _RAISED_COLLARS
    rotations[:, JOINT_INDEX["right_collar"], 2] -= _RAISED_COLLARS
    rotations[:, JOINT_INDEX["head"], 0] = 0.0
    for side in ("left", "right"):
        rotations[:, JOINT_INDEX[f"{side}_wrist"]] = 0.0
    return replace(poses, rotations=rotations)
