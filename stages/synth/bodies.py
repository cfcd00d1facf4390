"""Two people of clearly different shape, and their body surface in any pose.

Shapes are asked for by measures (height, girth, leg girth, shoulder width), not by shape coefficients, so
that the two people look the same whatever basis the embedded body happens to use.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.shared.body import JOINT_INDEX, BodyModel, bone_transforms, shaped_joints, skin
from stages.shared.body.skeleton import PARENTS
from stages.shared.meshes import edges
from stages.synth.offset_surface import border_vertices, neighbour_mean

Doubles = NDArray[np.float64]

TORSO = ("pelvis", "spine1", "spine2", "spine3")
_HAND_PARTS = ("wrist", "thumb", "index", "middle", "ring", "pinky")
LEGS = ("left_hip", "right_hip", "left_knee", "right_knee")
# Keeps the coefficients near what the population has; larger gives milder bodies.
_PRIOR = 0.004


@dataclass(frozen=True)
class Person:
    """What is asked of a body: differences from the mean adult, metres.

    Attributes:
        name: folder of the capture.
        height, torso_girth, leg_girth, shoulder_width: differences; girths are mean radii.
        hair_length: metres that the hair reaches below the ears at the back.
        skin, hair, shoes: albedo, sRGB 0..1.
    """

    name: str
    height: float
    torso_girth: float
    leg_girth: float
    shoulder_width: float
    hair_length: float
    skin: tuple[float, float, float]
    hair: tuple[float, float, float]
    shoes: tuple[float, float, float]


PERSON_1 = Person(
    "subject_1",
    -0.13,
    -0.016,
    -0.004,
    -0.022,
    0.055,
    (0.86, 0.66, 0.54),
    (0.30, 0.17, 0.09),
    (0.16, 0.17, 0.24),
)
PERSON_2 = Person(
    "subject_2", 0.06, 0.022, 0.008, 0.022, 0.02, (0.62, 0.43, 0.32), (0.10, 0.09, 0.09), (0.55, 0.36, 0.20)
)


def betas_of(body: BodyModel, person: Person) -> NDArray[np.float32]:
    """(10,) shape whose measures differ from the mean as the person asks (regularised least squares)."""
    template = body.template_vertices.astype(np.float64)
    directions = body.shape_directions.astype(np.float64)  # (V, 3, 10)
    joints = np.asarray(body.joint_regressor, np.float64) @ template  # (J, 3)
    owner = body.skin_weights.argmax(axis=1)
    top, bottom = template[:, 1].argmax(), template[:, 1].argmin()
    shoulders = np.einsum("jv,vkb->jkb", np.asarray(body.joint_regressor, np.float64), directions)
    rows = np.stack(
        [
            directions[top, 1] - directions[bottom, 1],
            _radial(template, directions, joints, owner, TORSO),
            _radial(template, directions, joints, owner, LEGS),
            shoulders[JOINT_INDEX["left_shoulder"], 0] - shoulders[JOINT_INDEX["right_shoulder"], 0],
        ]
    )
    targets = np.array([person.height, person.torso_girth, person.leg_girth, person.shoulder_width])
    scale = np.array([0.2, 1.0, 1.0, 0.7])  # a centimetre of girth shows more than one of height
    rows, targets = rows * scale[:, None], targets * scale
    normal = rows.T @ rows + _PRIOR**2 * np.eye(rows.shape[1])
    return np.linalg.solve(normal, rows.T @ targets).astype(np.float32)


def _radial(
    template: Doubles,
    directions: Doubles,
    joints: Doubles,
    owner: NDArray[np.integer],
    names: tuple[str, ...],
) -> Doubles:
    """(10,) mean change of the horizontal distance from the bone, over the vertices of those joints."""
    rows = []
    for name in names:
        joint = JOINT_INDEX[name]
        chosen = np.flatnonzero(owner == joint)
        away = template[chosen] - joints[joint]
        away[:, 1] = 0.0
        away /= np.linalg.norm(away, axis=1, keepdims=True) + 1e-9
        rows.append(np.einsum("vk,vkb->b", away, directions[chosen]) / len(chosen))
    return np.mean(rows, axis=0)


class ShapedBody:
    """A body of one shape: poses its surface and meshes that move with its bones."""

    def __init__(self, model: BodyModel, betas: NDArray[np.float32]) -> None:
        self.model = model
        self.betas = betas
        shape = torch.from_numpy(np.asarray(betas, np.float64))
        self._joints = shaped_joints(model, shape)
        self.rest_vertices: Doubles = (
            model.template_vertices.astype(np.float64) + model.shape_directions.astype(np.float64) @ betas
        )
        self.joints: Doubles = self._joints.numpy()
        self.faces = np.ascontiguousarray(model.faces, dtype=np.int64)
        self.weights: Doubles = model.skin_weights.astype(np.float64)

    def transforms(self, rotations: NDArray[np.floating], translation: NDArray[np.floating]) -> Doubles:
        """(..., 55, 4, 4) posed_from_rest of (..., 55, 3) axis-angle and (..., 3) metres."""
        turned = torch.from_numpy(np.asarray(rotations, np.float64))
        moved = torch.from_numpy(np.asarray(translation, np.float64))
        return bone_transforms(turned, self._joints, PARENTS, moved).numpy()

    def pose(self, points: Doubles, weights: Doubles, transforms: Doubles) -> Doubles:
        """(..., V, 3) of rest points (V, 3), weights (V, 55), transforms (..., 55, 4, 4)."""
        return skin(torch.from_numpy(points), torch.from_numpy(weights), torch.from_numpy(transforms)).numpy()

    def transfer(self, points: Doubles, faces: NDArray[np.int64], values: Doubles) -> Doubles:
        """(V, K) values of this body's vertices (B, K) at points (V, 3) of a mesh around its rest pose.

        They are averaged by inverse squared distance over 24 vertices of the body without hands, then
        smoothed over the mesh with faces (F, 3).
        """
        names = self.model.joint_names
        hands = [joint for joint, name in enumerate(names) if any(part in name for part in _HAND_PARTS)]
        usable = np.flatnonzero(~np.isin(self.weights.argmax(axis=1), hands))
        distance, nearest = cKDTree(self.rest_vertices[usable]).query(points, k=24)
        share = 1.0 / np.maximum(distance, 1e-3) ** 2
        share /= share.sum(axis=1, keepdims=True)
        transferred = np.einsum("vk,vkc->vc", share, values[usable[nearest]])
        all_edges = edges(faces)
        average = neighbour_mean(len(points), all_edges)
        border = border_vertices(len(points), faces)
        along = neighbour_mean(len(points), all_edges[border[all_edges].all(axis=1)])
        for _ in range(25):
            mean = np.where(border[:, None], along @ transferred, average @ transferred)
            transferred = 0.5 * transferred + 0.5 * mean
        return transferred
