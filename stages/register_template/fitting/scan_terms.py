"""Residuals of a body inside of a scan: skin follows bare skin, and clothes may lie outside of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.register_template.fitting.bones import Doubles, SurfacePoints, surface_points
from stages.register_template.fitting.solve import Residuals
from stages.shared.body import BodyModel
from stages.shared.layers import SKIN_CONTACT
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import face_normals, vertex_normals

# How many independent measurements a scan is worth against priors of spread one, and how well each is known.
_MEASUREMENTS = 1000.0
_NOISE_M, _NOISE_SHARE = 0.004, 0.2  # the least, and a share of the robust distance
_SAME_SIDE = 0.3  # least cosine between normals of paired points
_ESCAPING_RAYS, _RAYS = 2, 24  # a body point from which fewer rays escape is inside the mouth or an eye


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """Points of a scan, in random order.

    Attributes:
        points: (M, 3) metres. normals: (M, 3) unit. colors: (M, 3) sRGB 0..1, or None.
        contact: (M,) how closely the body's skin must follow each point: 1 for bare skin, 0 for cloth that
            may be anywhere outside of the body.
        tree: of the points.
    """

    points: Doubles
    normals: Doubles
    colors: Doubles | None
    contact: Doubles
    tree: cKDTree

    def thinned(self, count: int) -> ScanPoints:
        """The first `count` of the points, which are in random order."""
        if count >= len(self.points):
            return self
        colors = None if self.colors is None else self.colors[:count]
        return ScanPoints(
            self.points[:count],
            self.normals[:count],
            colors,
            self.contact[:count],
            cKDTree(self.points[:count]),
        )

    def contact_at_least(self, share: float) -> ScanPoints:
        """The same points, each with a contact of at least `share`."""
        return replace(self, contact=np.maximum(self.contact, share))


def spread_points(
    vertices: NDArray, faces: NDArray, count: int, seed: int = 0
) -> tuple[NDArray[np.intp], Doubles]:
    """Faces (count,) and barycentric shares (count, 3) of points spread uniformly by area."""
    random = np.random.default_rng(seed)
    areas = face_normals(vertices, faces)[1]
    chosen = random.choice(len(faces), count, p=areas / areas.sum())
    first, second = np.sqrt(random.random(count)), random.random(count)
    return chosen, np.stack([1 - first, first * (1 - second), first * second], axis=1)


def scan_points(mesh: Mesh, count: int, seed: int = 0) -> ScanPoints:
    """`count` points of a scan; its labels say what is bare skin, without them everything is."""
    chosen, shares = spread_points(mesh.vertices, mesh.faces, count, seed)
    corners = mesh.faces[chosen]
    points = np.einsum("mk,mkc->mc", shares, mesh.vertices[corners].astype(np.float64))
    smooth = np.einsum("mk,mkc->mc", shares, vertex_normals(mesh.vertices, mesh.faces)[corners])
    length = np.linalg.norm(smooth, axis=1, keepdims=True)
    flat = face_normals(mesh.vertices, mesh.faces)[0][chosen]
    normals = np.where(length > 1e-6, smooth / np.maximum(length, 1e-6), flat)
    contact = np.ones(count)
    if mesh.labels is not None:
        labels = mesh.labels[corners]
        for label, share in SKIN_CONTACT.items():
            contact = np.where((labels == label).any(axis=1), np.minimum(contact, share), contact)
    colors = None
    if mesh.colors is not None:
        colors = np.einsum("mk,mkc->mc", shares, mesh.colors[corners] / 255.0)
    return ScanPoints(points, normals, colors, contact, cKDTree(points))


def outer_points(body: BodyModel, count: int, seed: int = 0) -> SurfacePoints:
    """About `count` points spread over the body's outside; mouth and eye sockets are left out."""
    chosen, shares = spread_points(body.template_vertices, body.faces, count, seed)
    normals = face_normals(body.template_vertices, body.faces)[0][chosen]
    corners = body.template_vertices[body.faces[chosen]].astype(np.float64)
    points = np.einsum("ks,ksc->kc", shares, corners) + 1e-3 * normals
    directions = np.random.default_rng(seed + 1).normal(size=(count, _RAYS, 3))
    directions *= np.sign(np.einsum("krc,kc->kr", directions, normals))[..., None]
    scene = RayScene(body.template_vertices, body.faces)
    escaping = ~scene.first_hits(points[:, None], directions).hit
    outside = escaping.sum(axis=1) >= _ESCAPING_RAYS
    return surface_points(body, chosen[outside], shares[outside])


@dataclass(frozen=True, eq=False)
class Nearest:
    """For every scan point its nearest point on the posed body: faces (M,), shares (M, 3), unit normals
    (M, 3), signed distance (M,) positive outside of the body, squared distance (M,), metres."""

    faces: NDArray[np.int32]
    shares: Doubles
    normals: Doubles
    outside: Doubles
    squared: Doubles


def nearest_on_body(body: BodyModel, vertices: Doubles, points: Doubles) -> Nearest:
    """Where `points` (M, 3) are nearest to the body with posed `vertices` (V, 3)."""
    closest, faces, shares = RayScene(vertices, body.faces).closest(points)
    normals = face_normals(vertices, body.faces[faces])[0]
    offset = points - closest
    return Nearest(
        faces,
        shares.astype(np.float64),
        normals,
        np.einsum("mc,mc->m", offset, normals),
        np.einsum("mc,mc->m", offset, offset),
    )


def from_scan(body: BodyModel, vertices: Doubles, scan: ScanPoints, robust: float) -> Residuals:
    """Every scan point to the plane of the body's surface nearest to it.

    A scan point inside of the body means that skin pokes out. It counts fully. A point outside counts by its
    contact. Pairs that are far apart, or face away from each other, do not count.

    Arguments:
        vertices: (V, 3) posed. robust: metres at which a distance begins to mean nothing (Geman-McClure).
    """
    near = nearest_on_body(body, vertices, scan.points)
    agree = np.einsum("mc,mc->m", near.normals, scan.normals) > _SAME_SIDE
    contact = np.where(near.outside > 0, scan.contact, 1.0)
    weights = agree * contact * _kernel(near.squared, robust) * _scale(robust, len(scan.points))
    used = weights > 0
    points = surface_points(body, near.faces[used], near.shares[used])
    return Residuals(points, near.outside[used], -near.normals[used], weights[used])


def from_body(points: SurfacePoints, positions: Doubles, scan: ScanPoints, robust: float) -> Residuals:
    """Body points (K, 3) to the plane of the scan point nearest to them.

    Points outside of the scan count fully. Inside they count little, because there are clothes, and the scan
    may have holes.
    """
    near = scan.tree.query(positions)[1]
    offset = positions - scan.points[near]
    outside = np.einsum("kc,kc->k", offset, scan.normals[near])
    contact = np.where(outside > 0, 1.0, 0.3 * scan.contact[near])
    weights = contact * _kernel((offset * offset).sum(axis=1), robust) * _scale(robust, len(positions))
    return Residuals(points, outside, scan.normals[near], weights)


def misfit(body: BodyModel, vertices: Doubles, outer: Doubles, scan: ScanPoints, robust: float) -> float:
    """One number, metres², to compare fits of the same scan by: robust distances of both surfaces.

    Arguments:
        outer: (K, 3) posed points of the body's outside.
    """
    near = nearest_on_body(body, vertices, scan.points)
    agree = np.einsum("mc,mc->m", near.normals, scan.normals) > _SAME_SIDE
    contact = np.where(near.outside > 0, np.maximum(scan.contact, 0.1), 1.0)
    lost = robust**2
    scan_side = np.where(agree, _robust(near.squared, robust), lost) * contact
    near_scan = scan.tree.query(outer)[1]
    offset = outer - scan.points[near_scan]
    poking = (offset * scan.normals[near_scan]).sum(axis=1) > 0
    body_side = np.where(poking, 1.0, 0.3) * _robust((offset * offset).sum(axis=1), robust)
    return float(scan_side.sum() / contact.sum() + body_side.mean())


def _scale(robust: float, count: int) -> float:
    return _MEASUREMENTS / (max(_NOISE_M, _NOISE_SHARE * robust) ** 2 * count)


def _kernel(squared: Doubles, robust: float) -> Doubles:
    """Weights of the Geman-McClure error."""
    return (robust**2 / (robust**2 + squared)) ** 2


def _robust(squared: Doubles, robust: float) -> Doubles:
    """The Geman-McClure error: squared for small distances, at most robust² for large ones."""
    return squared * robust**2 / (squared + robust**2)
