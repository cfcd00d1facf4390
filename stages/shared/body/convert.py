"""Poses for another body model with the same vertices (gendered to neutral SMPL-X), or in a turned world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import EXPRESSION_COUNT, SHAPE_COUNT
from stages.shared.errors import BadData

Doubles = NDArray[np.float64]


def convert_poses(poses: Poses, source: BodyModel, target: BodyModel) -> Poses:
    """The poses of `target` that put its vertices where `source` has them.

    Shape and expression solve linear least squares over all vertices of the rest pose:
    β_t = argmin ‖S_t β − (v_s + S_s β_s − v_t)‖², and the same for the displacement of the expression alone.
    Joint angles are taken over. The pelvis, about which the root turns, differs between models, so the
    translation becomes τ + (I − R)(J_s − J_t).

    Raises:
        BadData: the models do not have the same vertices.
    """
    if source.digest == target.digest:
        return poses
    if len(source.template_vertices) != len(target.template_vertices):
        raise BadData(
            f"The model of the fits has {len(source.template_vertices)} vertices, "
            f"the one in use {len(target.template_vertices)}: their shapes cannot be compared.",
            f"{source.source} and {target.source}",
            "Give two models of one family (--fit-body-model and --body-model), or fit again with --fit.",
        )
    betas = convert_betas(poses.betas, source, target)
    expression = _convert_expression(poses.expression, source, target)
    apart = _pelvis(source, poses.betas, poses.expression) - _pelvis(target, betas, expression)
    root = Rotation.from_rotvec(poses.rotations[:, 0].astype(np.float64))
    translation = poses.translation + apart - root.apply(apart)
    return Poses(
        poses.rotations,
        translation.astype(np.float32),
        betas.astype(np.float32),
        expression.astype(np.float32),
        poses.fps,
    )


def convert_betas(betas: NDArray[np.floating], source: BodyModel, target: BodyModel) -> Doubles:
    """(10,) betas of `target` whose rest vertices are nearest to those of `source` with `betas` (10,)."""
    shaped = source.template_vertices.astype(np.float64) + source.shape_directions @ betas.astype(np.float64)
    target_offsets = (shaped - target.template_vertices).reshape(-1)
    directions = target.shape_directions.reshape(-1, SHAPE_COUNT).astype(np.float64)
    return np.asarray(np.linalg.lstsq(directions, target_offsets, rcond=None)[0], np.float64)


def _convert_expression(
    expression: NDArray[np.float32], source: BodyModel, target: BodyModel
) -> NDArray[np.floating]:
    """(T, 10) expression of `target` with the displacements of `source`; zero where either has none."""
    if source.expression_directions is None or target.expression_directions is None or not expression.any():
        return np.zeros_like(expression)
    source_directions = source.expression_directions[..., :EXPRESSION_COUNT].astype(np.float64)
    used = expression[:, : source_directions.shape[-1]].astype(np.float64)
    displacements = np.einsum("vce,te->vct", source_directions, used).reshape(-1, len(expression))
    directions = target.expression_directions[..., :EXPRESSION_COUNT].astype(np.float64)
    solution = np.linalg.lstsq(directions.reshape(-1, directions.shape[-1]), displacements, rcond=None)[0]
    result = np.zeros((len(expression), EXPRESSION_COUNT))
    result[:, : len(solution)] = solution.T
    return result


def _pelvis(body: BodyModel, betas: NDArray[np.floating], expression: NDArray[np.floating]) -> Doubles:
    """(T, 3) rest pelvis of every frame."""
    pelvis = body.joint_template[0] + body.joint_directions[0] @ betas.astype(np.float64)
    rows = np.repeat(pelvis[None], len(expression), axis=0)
    if body.joint_expression_directions is not None:
        count = min(body.joint_expression_directions.shape[-1], expression.shape[1])
        rows = rows + expression[:, :count] @ body.joint_expression_directions[0, :, :count].T
    return rows


def turned_poses(body: BodyModel, poses: Poses, turn: NDArray[np.floating]) -> Poses:
    """The poses whose vertices are `turn` (3, 3) times those of `poses`.

    The root turns about the pelvis joint J0, not about the origin: v = R (x − J0) + J0 + τ, so the turned
    translation is turn (J0 + τ) − J0.
    """
    pelvis = body.joint_template[0] + body.joint_directions[0] @ poses.betas
    rotations = poses.rotations.copy()
    root = Rotation.from_matrix(turn) * Rotation.from_rotvec(rotations[:, 0])
    rotations[:, 0] = root.as_rotvec()
    translation = (poses.translation + pelvis) @ np.asarray(turn, np.float64).T - pelvis
    return replace(poses, rotations=rotations, translation=translation.astype(np.float32))
