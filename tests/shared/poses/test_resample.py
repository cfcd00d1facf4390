"""Other frame rates, against scipy's slerp."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from stages.shared.body import Poses
from stages.shared.errors import UsageProblem
from stages.shared.poses.convert import resample


def some_poses(frames: int, fps: float) -> Poses:
    random = np.random.default_rng(4)
    rotations = np.cumsum(random.normal(0, 0.3, (frames, 55, 3)), axis=0)
    return Poses(
        rotations, random.normal(0, 1, (frames, 3)), np.ones(10), random.normal(0, 1, (frames, 10)), fps
    )


@pytest.mark.parametrize(
    ("before", "after", "frames", "wanted"), [(120, 30, 41, 11), (24, 30, 13, 16), (30, 30, 7, 7)]
)
def test_count_times_and_values(before: float, after: float, frames: int, wanted: int) -> None:
    poses = some_poses(frames, before)
    result = resample(poses, after)
    assert len(result) == wanted and result.fps == after
    times = np.arange(wanted) / after
    known = np.arange(frames) / before
    for joint in (0, 17, 54):
        slerp = Slerp(known, Rotation.from_rotvec(poses.rotations[:, joint]))
        expected = slerp(np.minimum(times, known[-1])).as_matrix()
        got = Rotation.from_rotvec(result.rotations[:, joint]).as_matrix()
        np.testing.assert_allclose(got, expected, atol=1e-5)
    for axis in range(3):
        wanted_axis = np.interp(times, known, poses.translation[:, axis])
        np.testing.assert_allclose(result.translation[:, axis], wanted_axis, atol=1e-5)


def test_nearly_opposite_rotations_take_the_short_way() -> None:
    rotations = np.zeros((2, 55, 3))
    rotations[0, :, 0], rotations[1, :, 0] = np.pi - 0.1, -np.pi + 0.1  # 0.2 rad apart, the short way
    poses = Poses(rotations, np.zeros((2, 3)), np.zeros(10), np.zeros((2, 10)), 10.0)
    middle = resample(poses, 20.0).rotations[1, 5]
    assert abs(abs(middle[0]) - np.pi) < 1e-4


def test_a_single_frame_and_nonsense() -> None:
    assert len(resample(some_poses(1, 60), 30)) == 1
    for fps in (0.0, -5.0, float("nan")):
        with pytest.raises(UsageProblem):
            resample(some_poses(3, 30), fps)
