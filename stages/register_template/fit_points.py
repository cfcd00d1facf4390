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

# A body outside of the clothes is worse than a body inside of them.
_OUTSIDE_WEIGHT = 3.0
_INSIDE_SHARE = 0.5  # of the robust distance, for pairs that clothes may have set apart
_PLANE_SHARE = 0.8  # of a pair's distance that is measured along the normal


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
        """World points and unit normals, each (..., S, 3).

        Arguments: rotations (..., 55, 3) axis-angle, translation (..., 3) metres, betas (..., 10).
        """
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


@dataclass(frozen=True)
class Pairs:
    """Which points are compared, found for one pose and good for a few steps around it.

    Attributes:
        place, plane: (S, 3) for every body point the nearest mesh point and its normal; agrees (S,) 0 or 1.
        back: (M,) for every mesh point the nearest body point; back_agrees (M,) 0 or 1.
        targets: (M, 3) the mesh points.
    """

    place: Tensor
    plane: Tensor
    agrees: Tensor
    back: NDArray[np.intp]
    back_agrees: Tensor
    targets: Tensor


def find_pairs(points: Tensor, normals: Tensor, target: MeshSamples) -> Pairs:
    """Nearest points both ways; those whose normals disagree by more than a right angle are marked."""
    here, facing = points.detach().numpy(), normals.detach().numpy()
    near = target.tree.query(here)[1]
    back = cKDTree(here).query(target.points)[1]
    return Pairs(
        torch.from_numpy(target.points[near]),
        torch.from_numpy(target.normals[near]),
        _same_side(facing, target.normals[near]),
        back,
        _same_side(facing[back], target.normals),
        torch.from_numpy(target.points),
    )


def residual(points: Tensor, pairs: Pairs, robust: float) -> Tensor:
    """How badly posed body points (S, 3) fit a mesh: one number, metres² of a robust distance.

    Both directions: every body point to the plane of the mesh point paired with it, every mesh point to its
    body point. Clothes lie outside of bodies: a body point outside of the mesh counts more, and one inside
    soon stops to count, as does a mesh point away from the body.

    Arguments:
        robust: distance in metres at which a pair begins to count as unrelated.
    """
    signed = ((points - pairs.place) * pairs.plane).sum(-1)
    squared = _PLANE_SHARE * signed**2 + (1 - _PLANE_SHARE) * ((points - pairs.place) ** 2).sum(-1)
    outside = _OUTSIDE_WEIGHT * _robust(squared, robust)
    to_mesh = pairs.agrees * torch.where(signed > 0, outside, _robust(squared, _INSIDE_SHARE * robust))
    away = ((points[pairs.back] - pairs.targets) ** 2).sum(-1)
    to_body = pairs.back_agrees * _robust(away, _INSIDE_SHARE * robust)
    # Leaving pairs out must not pay: what does not count costs as much as a pair far apart.
    lost = robust**2 * ((1 - pairs.agrees).mean() + (1 - pairs.back_agrees).mean())
    return to_mesh.mean() + to_body.mean() + lost


def _same_side(first: Doubles, second: Doubles) -> Tensor:
    """(N,) 1 where two sets of normals (N, 3) point to the same half, else 0."""
    return torch.from_numpy((np.einsum("nc,nc->n", first, second) > 0).astype(np.float64))


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
