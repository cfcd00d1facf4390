"""Skinning with the joints that count is skinning with all of them, in poses that rest or move."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import torch
from torch import Tensor

from stages.shared.avatar import used_joints
from stages.shared.avatar.deform import blended
from stages.shared.avatar.pose import frame_pose
from stages.shared.avatar.used_joints import GROUPS, at_rest, describe_rest, used
from stages.shared.body import JOINT_INDEX, embedded_body
from tests.every_joint import every_joint

NAMES = list(GROUPS)


def _transforms(moved: tuple[str, ...] = (), amount: float = 0.3) -> Tensor:
    """Bone transforms of a random body pose; of the joints in groups only the named ones turn."""
    random = np.random.default_rng(3)
    rotations = np.zeros((55, 3), np.float32)
    rotations[:22] = random.normal(0, 0.4, (22, 3))
    for joint in ("left_foot", "right_foot"):
        rotations[JOINT_INDEX[joint]] = 0
    for name in moved:
        rotations[GROUPS[name].members[-1]] = amount
    body = embedded_body()
    arrays = (rotations, np.array([0.3, 1.0, -0.2], np.float32), random.normal(0, 1, 10).astype(np.float32))
    return frame_pose(body, *(torch.from_numpy(array) for array in arrays)).transforms


def _weights(joints: list[int], texels: int = 400) -> Tensor:
    """Weights on these joints alone, rows that sum to one."""
    weights = torch.zeros(texels, 55)
    generator = torch.Generator().manual_seed(0)
    weights[:, joints] = torch.rand(texels, len(joints), generator=generator)
    return weights / weights.sum(dim=1, keepdim=True)


def _plain(weights: Tensor, transforms: Tensor) -> Tensor:
    rows = weights.double() @ transforms[:, :3].reshape(-1, 12).double()
    return rows.view(-1, 3, 4)


@pytest.mark.parametrize("moved", [(), ("left hand",), ("face", "right toes"), tuple(NAMES)])
def test_same_matrices_whatever_moves(moved: tuple[str, ...]) -> None:
    weights, transforms = _weights(list(range(55))), _transforms(moved)
    assert at_rest(transforms) == tuple(name not in moved for name in NAMES)
    fewer, bones = used(weights, transforms)
    resting = sum(len(group.members) for name, group in GROUPS.items() if name not in moved)
    assert fewer.shape == (400, 55 - resting) and len(bones) == 55 - resting
    assert (blended(weights, transforms) - _plain(weights, transforms)).abs().max() < 3e-6
    with every_joint():
        assert used(weights, transforms)[0] is weights


def test_a_new_motion_is_skinned_with_the_fingers() -> None:
    """The same layer, first in poses with still hands, then in one that closes a fist a little."""
    weights = _weights([20, 37, 38, 39])
    still = blended(weights, _transforms())
    assert used(weights, _transforms())[0].shape == (400, 1)
    moving = _transforms(("left hand",), amount=0.01)
    found = blended(weights, moving)
    assert used(weights, moving)[0].shape == (400, 4)
    assert (found - _plain(weights, moving)).abs().max() < 3e-6
    assert (found - still).abs().max() > 1e-4


def test_joints_without_weight_are_left_out() -> None:
    skirt = _weights([0, 1, 2, 4, 5])
    fewer, bones = used(skirt, _transforms(tuple(NAMES)))
    assert fewer.shape == (400, 5) and len(bones) == 5
    assert torch.equal(fewer.sum(dim=1), skirt.sum(dim=1)) or torch.allclose(fewer.sum(1), skirt.sum(1))


def test_weights_that_change_are_looked_at_again_and_forgotten_with_them() -> None:
    weights, transforms = _weights([0, 1]), _transforms()
    blended(weights, transforms)
    weights[:, 3] = 1.0
    assert (blended(weights, transforms) - _plain(weights, transforms)).abs().max() < 3e-6
    key = id(weights)
    assert key in used_joints._kept
    del weights
    gc.collect()
    assert key not in used_joints._kept


def test_numbers_that_are_not_finite_are_left_to_the_caller() -> None:
    weights, transforms = _weights([0, 1]), _transforms()
    transforms[40, 0, 0] = torch.nan  # of a joint without weight
    assert used(weights, transforms)[0] is weights
    assert blended(weights, transforms).isnan().any()


def test_what_rests_in_a_whole_take_is_named() -> None:
    takes = torch.stack([_transforms(), _transforms(("left hand",))])
    assert describe_rest(takes) == {
        "face": "head",
        "right hand": "right_wrist",
        "left toes": "left_ankle",
        "right toes": "right_ankle",
    }
