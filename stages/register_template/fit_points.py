"""Points on the two surfaces that a fit compares, and the residuals between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from stages.shared.body.kinematics import blend, bone_transforms, shaped_joints
from stages.shared.body.model import BodyModel
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.topology import vertex_normals

Doubles = NDArray[np.float64]

# Distance at which a pair begins to count as unrelated (hair, wide skirts, missing parts), metres.
_ROBUST_M = 0.06
# A body outside of the clothes is worse than a body inside of them.
_OUTSIDE_WEIGHT, _INSIDE_WEIGHT = 3.0, 1.0


@dataclass(frozen=True)
class BodySamples:
    """S points spread evenly over the body's surface.

    Attributes:
        rest: (S, 3) rest frame of the mean shape. directions: (S, 3, 10). normals: (S, 3) rest frame.
        weights: (S, 55) skin weights.
    """

    body: BodyModel
    rest: Tensor
    directions: Tensor
    normals: Tensor
    weights: Tensor

    def posed(self, rotations: Tensor, translation: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
        """World points and unit normals, each (..., S, 3); rotations (..., 55, 3), translation (..., 3), betas (..., 10)."""
        joints = shaped_joints(self.body, betas)
        transforms = blend(self.weights, bone_transforms(rotations, joints, translation=translation))
        rest = self.rest + torch.einsum("scb,...b->...sc", self.directions, betas)
        turned = transforms[..., :3, :3]
        points = (turned @ rest.unsqueeze(-1)).squeeze(-1) + transforms[..., :3, 3]
        normals = (turned @ self.normals.unsqueeze(-1)).squeeze(-1)
        return points, normals / normals.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def body_samples(body: BodyModel, count: int, seed: int = 0) -> BodySamples:
    """`count` points on the body, uniform by area, the same for the same seed."""
    points, corners, shares = _spread(body.template_vertices, body.faces, count, seed)
    normals = vertex_normals(body.template_vertices, body.faces)

    def interpolated(values: NDArray) -> Tensor:
        return torch.from_numpy(np.einsum("sk,sk...->s...", shares, values[corners].astype(np.float64)))

    return BodySamples(
        body,
        torch.from_numpy(points),
        interpolated(body.shape_directions),
        interpolated(normals),
        interpolated(body.skin_weights),
    )


@dataclass(frozen=True)
class MeshSamples:
    """Points (S, 3) and unit normals (S, 3) on a mesh, with a tree for nearest points."""

    points: Doubles
    normals: Doubles
    tree: cKDTree

    def turned(self, rotation: Doubles, scale: float, shift: Doubles) -> MeshSamples:
        """The same points at scale · R p + shift."""
        points = scale * self.points @ rotation.T + shift
        return MeshSamples(points, self.normals @ rotation.T, cKDTree(points))


def mesh_samples(mesh: Mesh, count: int, seed: int = 0) -> MeshSamples:
    """`count` points on a mesh, uniform by area."""
    points, corners, shares = _spread(mesh.vertices, mesh.faces, count, seed)
    normals = np.einsum("sk,skc->sc", shares, vertex_normals(mesh.vertices, mesh.faces)[corners])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return MeshSamples(points, normals, cKDTree(points))


def residual(points: Tensor, normals: Tensor, target: MeshSamples, robust: float = _ROBUST_M) -> Tensor:
    """How badly posed body points (S, 3) with normals fit a mesh: one number, metres² of a robust distance.

    Both directions: every body point to the plane of the mesh point nearest to it (a body outside of the mesh
    counts more than inside, clothes lie outside of bodies), every mesh point to the nearest body point. Pairs whose
    normals disagree by more than a right angle do not count.
    """
    here, facing = points.detach().numpy(), normals.detach().numpy()
    near = target.tree.query(here)[1]
    plane, place = torch.from_numpy(target.normals[near]), torch.from_numpy(target.points[near])
    agrees = torch.from_numpy((np.einsum("sc,sc->s", facing, target.normals[near]) > 0).astype(np.float64))
    signed = ((points - place) * plane).sum(-1)
    weight = torch.where(signed > 0, _OUTSIDE_WEIGHT, _INSIDE_WEIGHT)
    apart = ((points - place) ** 2).sum(-1)
    to_mesh = agrees * weight * _robust(0.8 * signed**2 + 0.2 * apart, robust)

    back = cKDTree(here).query(target.points)[1]
    back_agrees = np.einsum("sc,sc->s", facing[back], target.normals) > 0
    away = ((points[back] - torch.from_numpy(target.points)) ** 2).sum(-1)
    to_body = torch.from_numpy(back_agrees.astype(np.float64)) * _robust(away, robust)
    # Leaving pairs out must not pay: what does not count costs as much as a pair far apart.
    lost = robust**2 * ((1 - agrees).mean() + float((~back_agrees).mean()))
    return to_mesh.mean() + to_body.mean() + lost


def _robust(squared: Tensor, scale: float) -> Tensor:
    """Geman-McClure: squared for small distances, no more than scale² for large ones."""
    return squared * scale**2 / (squared + scale**2)


def _spread(vertices: NDArray, faces: NDArray, count: int, seed: int) -> tuple[Doubles, NDArray, Doubles]:
    """Points (S, 3) uniform by area, with the corners (S, 3) of their faces and barycentric shares (S, 3)."""
    random = np.random.default_rng(seed)
    corners = vertices[faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = random.choice(len(faces), count, p=area / area.sum())
    first, second = np.sqrt(random.random(count)), random.random(count)
    shares = np.stack([1 - first, first * (1 - second), first * second], axis=1)
    return np.einsum("sk,skc->sc", shares, corners[chosen]), faces[chosen], shares
