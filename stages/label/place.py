"""How likely each label is at a place of the body, before any picture is looked at."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.body.kinematics import shaped_joints
from stages.shared.body.model import BodyModel
from stages.shared.body.posed import posed_body, row_transforms
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import JOINT_INDEX, JOINTS
from stages.shared.layers import LABEL_IDS, SKIN, label_id
from stages.shared.meshes.raycast import RayScene

Doubles = NDArray[np.float64]

HAIR, SHOE = label_id("hair"), label_id("shoe")
UPPER, LOWER = label_id("upper"), label_id("lower")
_ENDS = ("wrist", "ankle", "foot")
_FLOOR = 0.01
_FAR_FROM_SKIN_M = 0.03  # twice this far outside the body, skin is unlikely: cloth or hair is there
_SCALP_ABOVE_EYES_M, _SCALP_BEHIND_EYES_M = 0.045, 0.075

# Shares of the labels on the part of the body that moves with a joint.
_SHARES: dict[str, dict[int, float]] = {
    "pelvis": {LOWER: 0.75, UPPER: 0.2, SKIN: 0.05},
    "hip": {LOWER: 0.9, UPPER: 0.05, SKIN: 0.05},
    "spine1": {UPPER: 0.65, LOWER: 0.3, SKIN: 0.05},
    "spine": {UPPER: 0.92, SKIN: 0.05, HAIR: 0.03},
    "collar": {UPPER: 0.85, SKIN: 0.1, HAIR: 0.05},
    "knee": {LOWER: 0.6, SKIN: 0.4},
    "ankle": {SHOE: 0.55, SKIN: 0.35, LOWER: 0.1},
    "foot": {SHOE: 0.6, SKIN: 0.4},
    "neck": {SKIN: 0.6, UPPER: 0.2, HAIR: 0.2},
    "shoulder": {UPPER: 0.75, SKIN: 0.25},
    "elbow": {SKIN: 0.55, UPPER: 0.45},
    "wrist": {SKIN: 0.97, UPPER: 0.03},
    "face": {SKIN: 0.9, HAIR: 0.1},
    "scalp": {HAIR: 0.85, SKIN: 0.15},
}


def place_shares(points: Doubles, body: BodyModel, pose: Poses) -> Doubles:
    """(V, L) share of each label id at surface points (V, 3) m world, rows sum to 1.

    The nearest point of the fitted body says which part a point belongs to; on the head, what lies above the
    eyes or behind them is scalp. Nothing predicts an outer garment.

    Arguments:
        body: the fitted model. pose: one row.
    """
    vertices = posed_body(body, pose)
    nearest, face, barycentric = RayScene(vertices, body.faces).closest(points)
    weights = np.einsum("vk,vkj->vj", barycentric, body.skin_weights[body.faces[face]])
    scalp = _on_scalp(points, body, pose)
    table = np.stack([_vector(_part(name)) for name in JOINTS])
    head = [JOINT_INDEX[name] for name in ("head", "jaw", "left_eye_smplhf", "right_eye_smplhf")]
    shares = np.delete(weights, head, axis=1) @ np.delete(table, head, axis=0)
    on_head = weights[:, head].sum(axis=1, keepdims=True)
    shares += on_head * np.where(scalp[:, None], _vector("scalp"), _vector("face"))
    # Hands and feet are where a fit is least exact, so their distance says little.
    trunk_and_limbs = weights[:, [j for j, name in enumerate(JOINTS) if _part(name) not in _ENDS]].sum(axis=1)
    away = np.linalg.norm(points - nearest, axis=1) / _FAR_FROM_SKIN_M
    shares[:, SKIN] *= np.exp(-0.5 * trunk_and_limbs * np.minimum(away, 3.0) ** 2)
    shares += _FLOOR / len(LABEL_IDS)
    return np.asarray(shares / shares.sum(axis=1, keepdims=True), np.float64)


def _on_scalp(points: Doubles, body: BodyModel, pose: Poses) -> NDArray[np.bool_]:
    """(V,) whether a point is well above the eyes or behind them, where hair grows."""
    transform = row_transforms(body, pose)[JOINT_INDEX["head"]]  # posed_from_canonical
    canonical = (points - transform[:3, 3]) @ transform[:3, :3]
    joints = shaped_joints(body, torch.from_numpy(pose.betas)).numpy()
    eyes = joints[[JOINT_INDEX["left_eye_smplhf"], JOINT_INDEX["right_eye_smplhf"]]].mean(axis=0)
    above, before = canonical[:, 1] - eyes[1], canonical[:, 2] - eyes[2]
    return np.asarray((above > _SCALP_ABOVE_EYES_M) | (before < -_SCALP_BEHIND_EYES_M), np.bool_)


def _part(joint: str) -> str:
    """The row of `_SHARES` for a joint; fingers are like the wrist."""
    name = joint.removeprefix("left_").removeprefix("right_")
    name = {"spine2": "spine", "spine3": "spine", "head": "face", "jaw": "face", "eye_smplhf": "face"}.get(
        name, name
    )
    return name if name in _SHARES else "wrist"


def _vector(part: str) -> Doubles:
    return np.array([_SHARES[part].get(label, 0.0) for label in LABEL_IDS])
