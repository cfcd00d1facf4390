"""Only the joints that a layer follows, and that move in this very pose, take part in skinning.

Two economies, both exact but for rounding. A joint without weight in a layer moves nothing: a skirt follows
eight of 55. And a joint at rest moves with the one it hangs on: while the fingers of a hand are as in the
canonical pose, their bones have the transform of the wrist, and their weights are added to its own.

What is at rest is looked up in every pose, so that a motion that moves the fingers is skinned with them,
whatever the subject was trained in. Groups are whole hands, the face and the toes: few combinations, so that
the smaller weights are found once for each and kept.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX, LEFT_HAND, PARENTS, RIGHT_HAND

AT_REST = 1e-6
"""Entries of two bones' transforms (1, and m) that differ by less are taken for the same."""
FEWEST_TEXELS = 256
"""Layers with fewer texels are skinned with all joints: that is faster than looking at the pose."""
_MOST_KEPT = 8  # combinations of groups that are kept for one array of weights


@dataclass(frozen=True)
class _Group:
    """Joints that hang on one another, and the joint that carries them all."""

    members: tuple[int, ...]
    carrier: int


GROUPS: dict[str, _Group] = {
    "face": _Group((22, 23, 24), JOINT_INDEX["head"]),
    "left hand": _Group(tuple(range(LEFT_HAND.start, LEFT_HAND.stop)), JOINT_INDEX["left_wrist"]),
    "right hand": _Group(tuple(range(RIGHT_HAND.start, RIGHT_HAND.stop)), JOINT_INDEX["right_wrist"]),
    "left toes": _Group((JOINT_INDEX["left_foot"],), JOINT_INDEX["left_ankle"]),
    "right toes": _Group((JOINT_INDEX["right_foot"],), JOINT_INDEX["right_ankle"]),
}
_MEMBERS = torch.tensor([joint for group in GROUPS.values() for joint in group.members])
_CARRIERS = torch.tensor([group.carrier for group in GROUPS.values() for _ in group.members])
_SIZES = [len(group.members) for group in GROUPS.values()]

_kept: dict[int, tuple[weakref.ref[Tensor], int, dict[tuple[bool, ...], tuple[Tensor, Tensor]]]] = {}


def used(weights: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (N, K) and bone transforms (K, 4, 4) that blend to the same as (N, 55) and (55, 4, 4)."""
    if len(weights) < FEWEST_TEXELS or tuple(transforms.shape) != (JOINT_COUNT, 4, 4):
        return weights, transforms
    if weights.requires_grad or transforms.requires_grad or not bool(torch.isfinite(transforms.sum())):
        return weights, transforms  # what is not finite is for the caller to refuse
    smaller, joints = _smaller(weights, at_rest(transforms))
    return smaller, transforms[joints]


def at_rest(transforms: Tensor) -> tuple[bool, ...]:
    """Of every group, whether its joints move with their carrier in a pose, (55, 4, 4) bone transforms."""
    apart = (transforms[_MEMBERS] - transforms[_CARRIERS]).abs().amax(dim=(1, 2)) > AT_REST
    return tuple(not bool(part.any()) for part in apart.cpu().split(_SIZES))


def joints_at_rest(still: tuple[bool, ...]) -> list[int]:
    """The joints of groups that are at rest."""
    groups = zip(GROUPS.values(), still, strict=True)
    return [joint for group, resting in groups if resting for joint in group.members]


def _smaller(weights: Tensor, still: tuple[bool, ...]) -> tuple[Tensor, Tensor]:
    """Weights of the joints that count (N, K), and which those are (K,); kept as long as `weights` is."""
    key, version = id(weights), weights._version
    found = _kept.get(key)
    if found is None or found[0]() is not weights or found[1] != version:
        found = (weakref.ref(weights, lambda _: _kept.pop(key, None)), version, {})
        _kept[key] = found
    known = found[2]
    if still not in known:
        if len(known) >= _MOST_KEPT:
            known.clear()
        known[still] = _merged(weights, still)
    return known[still]


def _merged(weights: Tensor, still: tuple[bool, ...]) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        total = weights.clone()
        for group, resting in zip(GROUPS.values(), still, strict=True):
            if resting:
                members = list(group.members)
                total[:, group.carrier] += weights[:, members].sum(dim=1)
                total[:, members] = 0.0
        joints = (total != 0).any(dim=0).nonzero()[:, 0]
        return total[:, joints].contiguous(), joints


def describe_rest(transforms: Tensor) -> dict[str, str]:
    """Groups of joints that no pose of (T, 55, 4, 4) moves, and the joint that carries each."""
    still = [at_rest(pose) for pose in transforms]
    names = {index: name for name, index in JOINT_INDEX.items()}
    return {
        name: names[group.carrier]
        for place, (name, group) in enumerate(GROUPS.items())
        if all(pose[place] for pose in still)
    }


assert all(PARENTS[group.members[0]] == group.carrier for group in GROUPS.values())
