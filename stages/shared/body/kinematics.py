"""Forward kinematics and linear blend skinning in torch; any leading batch axes, float32 or float64.

The formulas are those of the SMPL family (Loper et al. 2015, sec. 3): axis-angle rotations relative to the
parent, G_i = G_parent(i) [R_i | J_i − J_parent(i)], bone transform A_i = G_i [I | −J_i], and a root
translation added to all bones. Functions follow the type and device of their first tensor argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.body.model import BodyModel
from stages.shared.body.skeleton import PARENTS
from stages.shared.errors import BadData
from stages.shared.finite import finite

# Below this squared angle the series is exact to the last bit of float64 (next term θ⁶/5040).
_SMALL_ANGLE_SQUARED = 1e-4
_LARGEST_BETA = 1e6
# Well beyond half a turn, the angle's own rounding in float32 would show in its sine and in the gradient.
_LARGE_ANGLE_SQUARED = 12.0


def rotation_matrices(axis_angle: Tensor) -> Tensor:
    """Rodrigues' formula, with right values and gradients at and around zero.

    Arguments:
        axis_angle: (..., 3), radians times unit axis.

    Returns:
        (..., 3, 3) rotation matrices.
    """
    x, y, z = axis_angle.unbind(-1)
    squared = (axis_angle * axis_angle).sum(-1)
    if axis_angle.dtype != torch.float64 and bool((squared > _LARGE_ANGLE_SQUARED).any()):
        return rotation_matrices(axis_angle.double()).to(axis_angle.dtype)
    small = squared < _SMALL_ANGLE_SQUARED
    angle = torch.sqrt(torch.where(small, torch.ones_like(squared), squared))
    half_sine = torch.sin(0.5 * angle)
    sine = torch.where(small, 1 - squared / 6 + squared**2 / 120, torch.sin(angle) / angle)
    versine = torch.where(
        small, 0.5 - squared / 24 + squared**2 / 720, 2 * half_sine * half_sine / (angle * angle)
    )
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    outer = axis_angle.unsqueeze(-1) * axis_angle.unsqueeze(-2)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    matrices = (
        identity * (1 - versine * squared)[..., None, None]
        + sine[..., None, None] * cross
        + versine[..., None, None] * outer
    )
    return finite(matrices, "rotation_matrices", axis_angle=axis_angle)


def shaped_joints(body: BodyModel, betas: Tensor, expression: Tensor | None = None) -> Tensor:
    """Rest joints of a shape.

    Arguments:
        betas: (..., 10).
        expression: (..., ≤E), used when the model has expression directions.

    Returns:
        (..., 55, 3) metres, rest frame.
    """
    _check_shape(betas)
    joints = constant(body.joint_template, betas) + torch.einsum(
        "jcb,...b->...jc", constant(body.joint_directions, betas), betas
    )
    if expression is not None and body.joint_expression_directions is not None:
        directions = constant(body.joint_expression_directions, betas)[..., : expression.shape[-1]]
        joints = joints + torch.einsum("jce,...e->...jc", directions, expression)
    return finite(joints, "shaped_joints", betas=betas, expression=expression)


def shaped_vertices(body: BodyModel, betas: Tensor, expression: Tensor | None = None) -> Tensor:
    """Rest vertices of a shape: v_template + S β + E ψ.

    Arguments:
        betas: (..., 10).
        expression: (..., ≤E), used when the model has expression directions.

    Returns:
        (..., V, 3) metres, rest frame.
    """
    _check_shape(betas)
    vertices = constant(body.template_vertices, betas) + torch.einsum(
        "vcb,...b->...vc", constant(body.shape_directions, betas), betas
    )
    if expression is not None and body.expression_directions is not None:
        directions = constant(body.expression_directions, betas)[..., : expression.shape[-1]]
        vertices = vertices + torch.einsum("vce,...e->...vc", directions, expression)
    return finite(vertices, "shaped_vertices", betas=betas, expression=expression)


def _check_shape(betas: Tensor) -> None:
    """Refuse coefficients that no body has and whose derivatives would leave the range of float32."""
    beyond = (betas.detach().abs() > _LARGEST_BETA).nonzero()
    if len(beyond):
        index = beyond[0].tolist()
        where = "betas" + "".join(f"[{i}]" for i in index)
        raise BadData(
            f"{where} is {float(betas.detach()[tuple(index)]):.3g}; a shape has coefficients of a few units.",
            where,
            "Look for the step that wrote it; nothing was made of it.",
        )


def bone_transforms(
    rotations: Tensor,
    joints: Tensor,
    parents: Sequence[int] | NDArray[np.int32] = PARENTS,
    translation: Tensor | None = None,
) -> Tensor:
    """Transforms of all bones, posed_from_rest.

    Arguments:
        rotations: (..., J, 3) axis-angle relative to the parent, radians.
        joints: (..., J, 3) rest joints, metres; leading axes broadcast against those of `rotations`.
        parents: (J,), −1 for the root, every parent before its children.
        translation: (..., 3) metres, added to every bone; None is zero.

    Returns:
        (..., J, 4, 4).
    """
    return _chain(rotation_matrices(rotations), joints, tuple(int(parent) for parent in parents), translation)


def _chain(local: Tensor, joints: Tensor, parents: tuple[int, ...], translation: Tensor | None) -> Tensor:
    """`bone_transforms` from rotation matrices (..., J, 3, 3)."""
    batch = torch.broadcast_shapes(local.shape[:-3], joints.shape[:-2])
    local = local.expand(*batch, *local.shape[-3:])
    joints = joints.expand(*batch, *joints.shape[-2:])
    levels = _levels(parents)
    turned, placed = local[..., levels[0].joints, :, :], joints[..., levels[0].joints, :]
    # One matrix product for all joints of the same depth: ten steps instead of fifty-five.
    for level in levels[1:]:
        above = turned[..., level.parent_rows, :, :]
        step = joints[..., level.joints, :] - joints[..., level.parents, :]
        placed = torch.cat([placed, placed[..., level.parent_rows, :] + _rotate(above, step)], -2)
        turned = torch.cat([turned, above @ local[..., level.joints, :, :]], -3)
    back = _rows_by_joint(parents)
    turned, placed = turned[..., back, :, :], placed[..., back, :]
    moved = placed - _rotate(turned, joints)
    if translation is not None:
        moved = moved + translation.unsqueeze(-2)
    moved = finite(moved, "bone_transforms", rotations=local, joints=joints, translation=translation)
    return _assemble(turned, moved)


def posed_joints(
    body: BodyModel,
    rotations: Tensor,
    translation: Tensor | None,
    betas: Tensor,
    expression: Tensor | None = None,
) -> Tensor:
    """World positions of the joints, (..., 55, 3) metres; arguments as in `posed_vertices`."""
    joints = shaped_joints(body, betas, expression)
    transforms = bone_transforms(rotations, joints, PARENTS, translation)
    return _rotate(transforms[..., :3, :3], joints) + transforms[..., :3, 3]


def posed_vertices(
    body: BodyModel,
    rotations: Tensor,
    translation: Tensor | None,
    betas: Tensor,
    expression: Tensor | None = None,
) -> Tensor:
    """Vertices of the body in the world.

    Arguments:
        rotations: (..., 55, 3) axis-angle.
        translation: (..., 3) metres, or None for zero.
        betas: (..., 10).
        expression: (..., ≤E) or None.

    Returns:
        (..., V, 3) metres, world frame. Pose correctives are applied when the model has them.
    """
    matrices = rotation_matrices(rotations)
    vertices = shaped_vertices(body, betas, expression)
    if body.pose_directions is not None:
        identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        feature = (matrices[..., 1:, :, :] - identity).flatten(-3)
        correction = feature @ constant(body.pose_directions, rotations)
        vertices = vertices + correction.unflatten(-1, (-1, 3))
    transforms = _chain(matrices, shaped_joints(body, betas, expression), PARENTS, translation)
    return skin(vertices, constant(body.skin_weights, rotations), transforms)


def blend(weights: Tensor, transforms: Tensor) -> Tensor:
    """Σ_j w_j T_j: the blended transform of every point.

    Arguments:
        weights: (V, J), rows sum to 1.
        transforms: (..., J, 4, 4).

    Returns:
        (..., V, 4, 4).
    """
    blended = (weights @ transforms.flatten(-2)).unflatten(-1, (4, 4))
    return finite(blended, "blend", weights=weights, transforms=transforms)


def skin(points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Linear blend skinning.

    Arguments:
        points: (V, 3) or (..., V, 3), metres, in the frame that `transforms` start from.
        weights: (V, J), rows sum to 1.
        transforms: (..., J, 4, 4).

    Returns:
        (..., V, 3), in the frame that `transforms` lead to.
    """
    # Three of the four rows are enough; the last one is (0, 0, 0, 1) for every affine blend.
    blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    moved = _rotate(blended[..., :3], points) + blended[..., 3]
    return finite(moved, "skin", points=points, weights=weights, transforms=transforms)


def rigid_inverse(transforms: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4)."""
    turned = transforms[..., :3, :3].transpose(-1, -2)
    moved = -_rotate(turned, transforms[..., :3, 3])
    return _assemble(turned, finite(moved, "rigid_inverse", transforms=transforms))


def _rotate(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors.unsqueeze(-1)).squeeze(-1)


def _assemble(turned: Tensor, moved: Tensor) -> Tensor:
    """(..., 3, 3) and (..., 3) to (..., 4, 4)."""
    top = torch.cat([turned, moved.unsqueeze(-1)], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], -2)


def constant(values: NDArray[np.floating], like: Tensor) -> Tensor:
    """An array of the model as a tensor of the type and device of `like`."""
    return torch.from_numpy(values).to(dtype=like.dtype, device=like.device)


@dataclass(frozen=True)
class _Level:
    """Joints of one depth: their numbers, their parents' numbers, their parents' rows in level order."""

    joints: list[int]
    parents: list[int]
    parent_rows: list[int]


@cache
def _levels(parents: tuple[int, ...]) -> tuple[_Level, ...]:
    """Joints by depth, the root first."""
    depth: list[int] = []
    for parent in parents:
        depth.append(0 if parent < 0 else depth[parent] + 1)
    by_depth = [[j for j, d in enumerate(depth) if d == level] for level in range(max(depth) + 1)]
    row = {joint: index for index, joint in enumerate(joint for joints in by_depth for joint in joints)}
    return tuple(
        _Level(joints, [parents[j] for j in joints], [row.get(parents[j], 0) for j in joints])
        for joints in by_depth
    )


@cache
def _rows_by_joint(parents: tuple[int, ...]) -> list[int]:
    """For every joint its row in the order in which `_levels` visits them."""
    order = [joint for level in _levels(parents) for joint in level.joints]
    return [order.index(joint) for joint in range(len(parents))]
