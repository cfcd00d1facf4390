"""Another frame rate for a motion: rotations by slerp, everything else linearly."""

from __future__ import annotations

import numpy as np
import torch

from stages.shared.body.poses import Poses
from stages.shared.errors import UsageProblem
from stages.shared.finite import finite


def resample(poses: Poses, fps: float) -> Poses:
    """The same motion at `fps` frames per second; first frame at the same time, none beyond the last.

    Arguments:
        poses: T frames.
        fps: > 0.

    Returns:
        floor((T−1)·fps/poses.fps) + 1 frames; `poses` itself when the rate is already right.

    Raises:
        UsageProblem: fps is not a positive number. BadData: a pose is not finite.
    """
    if not 0 < fps < 1e5:
        raise UsageProblem(
            f"{fps} is not a frame rate.", "frames per second", "Give a positive number, as 30."
        )
    if abs(fps - poses.fps) < 1e-6 * fps or len(poses) == 1:
        return poses if len(poses) > 1 else Poses(*_parts(poses), fps)
    import roma  # loads the whole of torch._dynamo: two seconds

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
        found = values[before] + (values[after] - values[before]) * share[:, None]
        return finite(found, "resample", translation=poses.translation, expression=poses.expression)

    return Poses(rotations, linear(poses.translation), poses.betas, linear(poses.expression), fps)


def _parts(poses: Poses) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return poses.rotations, poses.translation, poses.betas, poses.expression
