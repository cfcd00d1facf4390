"""Damped Gauss-Newton steps over the parameters of a few frames that share one shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.register_template.fitting.bones import Bones, Doubles, State, SurfacePoints
from stages.register_template.fitting.prior import Prior

_LONGEST_TURN = 0.35  # radians per step and joint
_LONGEST_OFFSET = 0.25  # metres per step
_LARGEST_CHANGE = 1.0  # of a beta per step
DAMPING = 1e-3  # share of the diagonal that is added to it


@dataclass(frozen=True, eq=False)
class Residuals:
    """K residuals and their derivatives with respect to their surface points.

    Attributes:
        points: the K points. values: (K,) metres. gradients: (K, 3). weights: (K,) per square metre.
    """

    points: SurfacePoints
    values: Doubles
    gradients: Doubles
    weights: Doubles

    @property
    def cost(self) -> float:
        """Σ w r²."""
        return float((self.weights * self.values**2).sum())


@dataclass(frozen=True, eq=False)
class ActiveParameters:
    """The parameters that a step changes: joints (J',) and betas (B',), by number, and all translations."""

    joints: NDArray[np.intp]
    betas: NDArray[np.intp]


def step(
    state: State,
    bones: Sequence[Bones],
    terms: Sequence[Sequence[Residuals]],
    prior: Prior,
    active: ActiveParameters,
    damping: float = DAMPING,
) -> State:
    """One step: normal equations of all residuals and the prior, solved for all frames and the shape.

    Arguments:
        bones: of each frame. terms: of each frame, the residuals at `state`.
    """
    width, shape = 3 + 3 * len(active.joints), len(active.betas)
    size = len(bones) * width + shape
    matrix, right = np.zeros((size, size)), np.zeros(size)
    tail = len(bones) * width + np.arange(shape)
    turns = (3 * active.joints[:, None] + np.arange(3)).reshape(-1)  # entries of the prior's 165
    for number, (skeleton, residuals) in enumerate(zip(bones, terms, strict=True)):
        first = number * width
        block = np.r_[first + np.arange(width), tail]
        for one in residuals:
            rows = skeleton.jacobian(one.points, one.gradients, active.joints)
            rows = np.concatenate([rows[:, :width], rows[:, width:][:, active.betas]], axis=1)
            rows *= np.sqrt(one.weights)[:, None].astype(np.float32)
            matrix[np.ix_(block, block)] += rows.T @ rows
            right[block] -= rows.T @ (np.sqrt(one.weights) * one.values).astype(np.float32)
        pose = first + 3 + np.arange(width - 3)
        hessian, slope = prior.pose(state.rotations[number], number)
        matrix[np.ix_(pose, pose)] += hessian[np.ix_(turns, turns)]
        right[pose] -= slope[turns]
    hessian_shape, slope_shape = prior.shape(state.betas)
    matrix[tail, tail] += hessian_shape[active.betas]
    right[tail] -= slope_shape[active.betas]
    diagonal = np.diag(matrix).copy()
    matrix[np.diag_indices(size)] += damping * diagonal + 1e-9 * diagonal.max()
    return _moved(state, np.asarray(np.linalg.solve(matrix, right), np.float64), active)


def _moved(state: State, solution: Doubles, active: ActiveParameters) -> State:
    """The state after small translations, turns in the parents' axes, and changes of the shape."""
    result = state.copy()
    frames, shape = len(state.rotations), len(active.betas)
    changes = solution[: len(solution) - shape].reshape(frames, -1)
    for number, change in enumerate(changes):
        offset, turns = change[:3], change[3:].reshape(-1, 3)
        length = max(float(np.linalg.norm(offset)), 1e-12)
        result.translation[number] += offset * min(1.0, _LONGEST_OFFSET / length)
        angles = np.linalg.norm(turns, axis=1, keepdims=True)
        turns = turns * np.minimum(1.0, _LONGEST_TURN / np.maximum(angles, 1e-12))
        before = Rotation.from_rotvec(result.rotations[number, active.joints])
        result.rotations[number, active.joints] = (Rotation.from_rotvec(turns) * before).as_rotvec()
    result.betas[active.betas] += np.clip(
        solution[len(solution) - shape :], -_LARGEST_CHANGE, _LARGEST_CHANGE
    )
    return result
