"""Real clips drive people of other shapes: limbs as in the file, feet on the floor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from stages.shared.body import JOINT_INDEX, Poses, embedded_body, posed_joints, posed_vertices
from stages.shared.outfit.retarget import fix_foot_height
from stages.shared.poses.bvh_file import read_bvh_file
from stages.shared.poses.bvh_names import joint_of_bone
from stages.shared.poses.read import load_poses

BODY = embedded_body()
CLIPS = ("cmu_12_01_walk", "bvh_test1", "bvh_test2", "bvh_test3")
LIMBS = tuple(
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
)
TALL = np.array([2.0, 0.5, 0, 0, 0, 0, 0, 0, 0, 0], np.float32)
SHORT = np.array([-2.0, 0, 0.5, 0, 0, 0, 0, 0, 0, 0], np.float32)


def lowest(poses: Poses) -> np.ndarray:
    """(T,) m height of the lowest vertex."""
    return np.array(
        [
            float(
                posed_vertices(
                    BODY,
                    torch.from_numpy(poses.rotations[frame]),
                    torch.from_numpy(poses.translation[frame]),
                    torch.from_numpy(poses.betas),
                )[:, 1].min()
            )
            for frame in range(0, len(poses), max(1, len(poses) // 6))
        ]
    )


def joints(poses: Poses) -> np.ndarray:
    rotations, translation, betas = (
        torch.from_numpy(value) for value in (poses.rotations, poses.translation, poses.betas)
    )
    return posed_joints(BODY, rotations, translation, betas).numpy()


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def clip(shared_folder: Path, name: str) -> Path:
    path = shared_folder / "poses" / f"{name}.bvh"
    if not path.is_file():
        pytest.skip("no clips beside the checkout (../shared/poses)")
    return path


@pytest.mark.parametrize(("name", "betas"), [(CLIPS[0], TALL), (CLIPS[3], SHORT)])
def test_feet_stay_on_the_floor(shared_folder: Path, name: str, betas: np.ndarray) -> None:
    made_for = load_poses(clip(shared_folder, name), BODY, 15)
    wearer = fix_foot_height(made_for, BODY, betas)
    before, after = lowest(made_for), lowest(wearer)
    assert abs(after.min() - before.min()) < 0.015
    assert np.ptp(after) < np.ptp(before) + 0.03
    naive = lowest(Poses(made_for.rotations, made_for.translation, betas, made_for.expression))
    assert abs(naive.min() - before.min()) > 2 * abs(after.min() - before.min())
    # Long legs take long steps.
    legs = np.linalg.norm(joints(wearer)[0, 4] - joints(wearer)[0, 1]) / np.linalg.norm(
        joints(made_for)[0, 4] - joints(made_for)[0, 1]
    )
    assert (legs > 1) == (betas is TALL or betas[0] > 0)


@pytest.mark.parametrize("name", CLIPS)
def test_no_limb_is_flipped(shared_folder: Path, name: str) -> None:
    """Limb directions of the dressed body, frame by frame, against the file's own forward kinematics."""
    path = clip(shared_folder, name)
    source = read_bvh_file(path)
    poses = load_poses(path, BODY)
    bone_of, theirs = joint_of_bone(source.names, source.parents), source.world()[1]
    ours = joints(poses)
    assert len(ours) == len(theirs)

    def directions(places: np.ndarray, at: dict[int, int] | None) -> np.ndarray:
        found = []
        for start, end in LIMBS:
            a, b = JOINT_INDEX[start], JOINT_INDEX[end]
            if at is not None:
                a, b = at[a], at[b]
            found.append(unit(places[:, b] - places[:, a]))
        return np.stack(found, axis=1)

    expected, seen = directions(theirs, bone_of), directions(ours, None)
    # One rotation takes the file's axes to ours; it is found from the first frame and holds for all limbs.
    u, _, v = np.linalg.svd(np.einsum("lk,lm->km", seen[0], expected[0]))
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v
    cosine = np.einsum("tlk,km,tlm->tl", seen, turn, expected)
    angle = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    assert angle.max() < 1.0, angle.max(axis=0)
    knees = [JOINT_INDEX["left_knee"], JOINT_INDEX["right_knee"]]
    steps = np.linalg.norm(np.diff(ours[:, knees], axis=0), axis=-1)
    # Metres from one frame to the next: nothing jumps, but out of the rest pose that some files begin with.
    assert steps[1:].max() < 0.15


def test_a_motion_made_for_the_wearer_is_left_alone() -> None:
    zeros = np.zeros((3, 10), np.float32)
    poses = Poses(np.zeros((3, 55, 3), np.float32), np.ones((3, 3), np.float32), TALL, zeros)
    assert fix_foot_height(poses, BODY, TALL) is poses
    other = fix_foot_height(poses, BODY, SHORT)
    assert np.array_equal(other.rotations, poses.rotations) and np.array_equal(other.betas, SHORT)
    assert abs(lowest(other).min() - lowest(poses).min()) < 1e-4
