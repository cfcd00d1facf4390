"""The canonical pose: T-pose arms, legs spread by 25° each, palms turned to the front.

Orthographic front and back views of this pose see the hands and the inner legs. Values are those of
Gaussian Wardrobe (hips ±25° about z, wrists −90° about x).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from stages.shared.body.kinematics import (
    bone_transforms,
    constant,
    rigid_inverse,
    shaped_joints,
)
from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import EXPRESSION_COUNT, JOINT_COUNT, JOINT_INDEX, PARENTS, SHAPE_COUNT

HIP_ANGLE = math.radians(25.0)
WRIST_ANGLE = -math.pi / 2


def canonical_rotations(dtype: torch.dtype = torch.float32) -> Tensor:
    """(55, 3) axis-angle of the canonical pose, radians."""
    rotations = torch.zeros(JOINT_COUNT, 3, dtype=dtype)
    rotations[JOINT_INDEX["left_hip"], 2] = HIP_ANGLE
    rotations[JOINT_INDEX["right_hip"], 2] = -HIP_ANGLE
    rotations[JOINT_INDEX["left_wrist"], 0] = WRIST_ANGLE
    rotations[JOINT_INDEX["right_wrist"], 0] = WRIST_ANGLE
    return rotations


def canonical_poses(frames: int = 1) -> Poses:
    """The canonical pose, standing still with the mean shape, as a motion of `frames` frames."""
    rotations = np.tile(canonical_rotations().numpy(), (frames, 1, 1))
    zeros = np.zeros((frames, EXPRESSION_COUNT), np.float32)
    return Poses(rotations, zeros[:, :3], np.zeros(SHAPE_COUNT, np.float32), zeros)


def canonical_from_rest(body: BodyModel, betas: Tensor) -> Tensor:
    """Bone transforms A^c_j(β) of the canonical pose, without root motion.

    Arguments:
        betas: (..., 10).

    Returns:
        (..., 55, 4, 4), canonical_from_rest; their translations are linear in β.
    """
    rotations = canonical_rotations(betas.dtype).to(betas.device)
    return bone_transforms(rotations, shaped_joints(body, betas), PARENTS)


def posed_from_canonical(
    body: BodyModel, rotations: Tensor, translation: Tensor | None, betas: Tensor
) -> Tensor:
    """M_j = A_j(θ, β, τ) A^c_j(β)⁻¹: from the canonical pose of shape β to the world.

    Arguments:
        rotations: (..., 55, 3) axis-angle.
        translation: (..., 3) metres, or None for zero.
        betas: (..., 10).

    Returns:
        (..., 55, 4, 4).
    """
    posed_from_rest = bone_transforms(rotations, shaped_joints(body, betas), PARENTS, translation)
    return posed_from_rest @ rigid_inverse(canonical_from_rest(body, betas))


def canonical_shape_directions(body: BodyModel, weights: Tensor, rest_directions: Tensor) -> Tensor:
    """How points of the canonical pose move with the shape, joints' motion included.

    A point p + Σ_b β_b o_b of the rest frame is skinned to the canonical pose by Σ_j w_j A^c_j(β), whose
    rotations do not depend on β and whose translations are linear in it. Hence, without remainder,
    x(β) = x(0) + Σ_b β_b d_b with d_b = (Σ_j w_j R^c_j) o_b + Σ_j w_j ∂t^c_j/∂β_b.

    Arguments:
        weights: (V, 55), rows sum to 1.
        rest_directions: (V, 3, 10) o_b, metres per unit of β, rest frame.

    Returns:
        (V, 10, 3) d_b, metres per unit of β, canonical frame.
    """
    directions = constant(body.joint_directions, weights)
    rotations = canonical_rotations(weights.dtype).to(weights.device)
    # The translations are a linear function of the joints, so their derivative along β_b is the same
    # function applied to ∂J/∂β_b.
    derivative = bone_transforms(rotations, directions.permute(2, 0, 1), PARENTS)
    turned = torch.einsum("vj,jkl->vkl", weights, derivative[0, :, :3, :3])
    moved = torch.einsum("vj,bjk->vbk", weights, derivative[..., :3, 3])
    return torch.einsum("vkl,vlb->vbk", turned, rest_directions) + moved
