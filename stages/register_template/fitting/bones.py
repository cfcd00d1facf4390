"""Points on the body and how they move with translation, joint rotations and shape, in closed form.

Turning joint j by a small ω (world axes) moves a skinned point x by ω × Σ_i w_i (x_i − P_j), where i runs
over the joints at and below j, x_i is where bone i alone would put the point, and P_j is the joint. Shape
moves it by Σ_i w_i (R_i ∂x_rest + ∂t_i). That is the whole Jacobian of linear blend skinning; pose
correctives, which change it by little, are left out of the derivative and kept in the vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body import PARENTS, BodyModel
from stages.shared.body.poses import DEFAULT_FPS, Poses
from stages.shared.body.skeleton import EXPRESSION_COUNT, JOINT_COUNT

Doubles = NDArray[np.float64]
Singles = NDArray[np.float32]


@dataclass(eq=False)
class State:
    """Parameters being fitted: T frames that share one shape.

    Attributes:
        rotations: (T, 55, 3) axis-angle. translation: (T, 3) metres. betas: (10,).
    """

    rotations: Doubles
    translation: Doubles
    betas: Doubles

    @classmethod
    def of(cls, poses: Poses) -> State:
        """The parameters of a pose sequence."""
        return cls(
            poses.rotations.astype(np.float64),
            poses.translation.astype(np.float64),
            poses.betas.astype(np.float64),
        )

    def poses(self, fps: float = DEFAULT_FPS) -> Poses:
        """As a pose sequence with a neutral face."""
        expression = np.zeros((len(self.rotations), EXPRESSION_COUNT), np.float32)
        return Poses(
            self.rotations.astype(np.float32),
            self.translation.astype(np.float32),
            self.betas.astype(np.float32),
            expression,
            fps,
        )

    def copy(self) -> State:
        """The same numbers, changeable on their own."""
        return State(self.rotations.copy(), self.translation.copy(), self.betas.copy())

    def frame(self, number: int) -> State:
        """One frame as a state of its own."""
        return State(
            self.rotations[number : number + 1].copy(),
            self.translation[number : number + 1].copy(),
            self.betas.copy(),
        )


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """K points of the body's surface: rest (K, 3), directions (K, 3, 10), skin weights (K, 55)."""

    rest: Doubles
    directions: Doubles
    weights: Doubles


_VERTICES: dict[str, SurfacePoints] = {}


def surface_points(body: BodyModel, faces: NDArray[np.integer], barycentric: NDArray) -> SurfacePoints:
    """The points at `barycentric` (K, 3) of the faces numbered (K,)."""
    corners = body.faces[faces]
    shares = barycentric.astype(np.float64)

    def mixed(values: NDArray) -> Doubles:
        return np.einsum("ks,ks...->k...", shares, values[corners].astype(np.float64))

    return SurfacePoints(
        mixed(body.template_vertices), mixed(body.shape_directions), mixed(body.skin_weights)
    )


@dataclass(frozen=True, eq=False)
class Bones:
    """The skeleton of one frame of a state.

    Attributes:
        turned: (55, 3, 3), moved: (55, 3): bone transforms, posed_from_rest.
        moved_by_shape: (55, 3, 10), their translations' derivative.
        joints: (55, 3) posed joints. above: (55, 3, 3) global rotation of every joint's parent.
        betas: (10,) the shape.
    """

    turned: Doubles
    moved: Doubles
    moved_by_shape: Doubles
    joints: Doubles
    above: Doubles
    betas: Doubles

    def positions(self, points: SurfacePoints) -> Doubles:
        """World positions (K, 3) of points."""
        rest = points.rest + points.directions @ self.betas
        blended = (points.weights @ self.turned.reshape(JOINT_COUNT, 9)).reshape(-1, 3, 3)
        return np.matmul(blended, rest[..., None])[..., 0] + points.weights @ self.moved

    def jacobian(self, points: SurfacePoints, gradients: Doubles, joints: NDArray[np.intp]) -> Singles:
        """(K, 3 + 3 J' + 10) derivative of gradients · position: translation, turns of `joints`, shape.

        Arguments:
            gradients: (K, 3), the derivative of each residual with respect to its point's position.
            joints: (J',) numbers of the joints that may turn.
        """
        # Single precision: the products below are most of the time of a fit, and need no more.
        rest = (points.rest + points.directions @ self.betas).astype(np.float32)
        slopes: Singles = gradients.astype(np.float32)
        weights, turned = points.weights.astype(np.float32), self.turned.astype(np.float32)
        count, below = len(rest), _below()[joints]
        each = (rest @ turned.reshape(-1, 3).T).reshape(count, JOINT_COUNT, 3)
        each += self.moved.astype(np.float32)
        each *= weights[..., None]  # where bone j alone puts the point, times its share
        lever = np.matmul(below, each)
        lever -= (weights @ below.T)[..., None] * self.joints[joints].astype(np.float32)
        world = _cross(lever, slopes[:, None])
        by_shape = weights @ self.moved_by_shape.reshape(JOINT_COUNT, -1).astype(np.float32)
        by_shape = by_shape.reshape(count, 3, -1)
        blended = (weights @ turned.reshape(JOINT_COUNT, 9)).reshape(count, 3, 3)
        by_shape += np.matmul(blended, points.directions.astype(np.float32))
        turns = np.einsum("jba,kjb->kja", self.above[joints].astype(np.float32), world)
        return np.concatenate(
            [slopes, turns.reshape(count, -1), np.matmul(slopes[:, None], by_shape)[:, 0]], axis=1
        )


def bones_of(body: BodyModel, state: State, frame: int = 0) -> Bones:
    """The skeleton of one frame."""
    local = Rotation.from_rotvec(state.rotations[frame]).as_matrix()
    rest = body.joint_template + body.joint_directions @ state.betas
    # One column for the joints themselves and ten for their derivatives: both are moved alike.
    columns = np.concatenate([rest[..., None], body.joint_directions], axis=-1)
    turned, above = np.empty((JOINT_COUNT, 3, 3)), np.empty((JOINT_COUNT, 3, 3))
    placed = np.empty_like(columns)
    for joint, parent in enumerate(PARENTS):
        above[joint] = np.eye(3) if parent < 0 else turned[parent]
        turned[joint] = above[joint] @ local[joint]
        if parent < 0:
            placed[joint] = columns[joint]
        else:
            placed[joint] = placed[parent] + above[joint] @ (columns[joint] - columns[parent])
    placed[..., 0] += state.translation[frame]
    moved = placed - turned @ columns
    return Bones(turned, moved[..., 0], moved[..., 1:], placed[..., 0], above, state.betas)


def vertices_of(body: BodyModel, state: State, frame: int = 0) -> Doubles:
    """(V, 3) posed vertices of one frame, world, metres; pose correctives are applied when there are any."""
    bones = bones_of(body, state, frame)
    if body.pose_directions is None:
        return bones.positions(all_vertices(body))
    local = Rotation.from_rotvec(state.rotations[frame, 1:]).as_matrix() - np.eye(3)
    correction = (local.reshape(-1).astype(np.float32) @ body.pose_directions).reshape(-1, 3)
    points = all_vertices(body)
    return bones.positions(SurfacePoints(points.rest + correction, points.directions, points.weights))


def all_vertices(body: BodyModel) -> SurfacePoints:
    """The body's vertices as surface points."""
    if body.digest not in _VERTICES:
        _VERTICES.clear()  # one model is in use at a time
        _VERTICES[body.digest] = SurfacePoints(
            body.template_vertices.astype(np.float64),
            body.shape_directions.astype(np.float64),
            body.skin_weights.astype(np.float64),
        )
    return _VERTICES[body.digest]


def _cross(first: Singles, second: Singles) -> Singles:
    """Cross product along the last axis; several times faster here than `np.cross`."""
    a, b, c = first[..., 0], first[..., 1], first[..., 2]
    x, y, z = second[..., 0], second[..., 1], second[..., 2]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


@cache
def _below() -> Singles:
    """(55, 55): 1 where the second joint is the first or hangs below it."""
    below = np.eye(JOINT_COUNT, dtype=np.float32)
    for joint in range(JOINT_COUNT - 1, 0, -1):
        below[PARENTS[joint]] += below[joint]
    return below
