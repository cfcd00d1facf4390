"""Residuals of a body behind its masks: clothes may widen a silhouette, skin may not leave it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.register_template.fitting.bones import Doubles, SurfacePoints, surface_points
from stages.register_template.fitting.contours import View
from stages.register_template.fitting.skin_contact import contact_of_joints
from stages.register_template.fitting.solve import Residuals
from stages.shared.body import BodyModel
from stages.shared.capture.camera import Camera
from stages.shared.meshes.topology import face_normals

_MEASUREMENTS = 150.0  # that one view is worth, against priors of spread one
_NOISE_M, _NOISE_SHARE = 0.006, 0.2
_NORMAL_PIXELS = 20.0  # opposite directions count like this many pixels
_SAME_SIDE = 0.5
_LEAST_DEPTH = 0.1
_EDGES: dict[str, NDArray[np.intp]] = {}


def outside_of_mask(points: SurfacePoints, positions: Doubles, view: View, robust: float) -> Residuals:
    """Body points whose projection lies outside of the mask, with their distance to it in metres."""
    value, metres, (rows, columns) = _mask_distance(positions, view)
    used = np.flatnonzero(value < 0)
    slope = view.slope[rows[used], columns[used]]
    gradients = _through_camera(view.camera, positions[used], slope) * metres[used, None]
    weights = _weights(value[used], robust, len(positions))
    return Residuals(_some(points, used), value[used], gradients, weights)


def outside_m(positions: Doubles, views: Sequence[View]) -> Doubles:
    """(K,) metres by which points lie outside of the mask that excludes them most; 0 inside of all masks."""
    beyond = np.zeros(len(positions))
    for view in views:
        value, _, _ = _mask_distance(positions, view)
        beyond = np.maximum(beyond, -value)
    return beyond


def contour_distance(
    body: BodyModel, vertices: Doubles, normals: Doubles, view: View, robust: float, least_contact: float
) -> Residuals:
    """Every contour point of the mask to the nearest point of the body's occluding contour.

    An occluding contour outside of the mask counts fully. One inside of it counts by the contact of the
    mask's contour point, from label images or from the place on the body.

    Arguments:
        vertices: (V, 3) posed. normals: (F, 3) of its faces.
        least_contact: smallest contact of any contour point.
    """
    faces, shares, directions = occluding_contour(body, vertices, normals, view.camera)
    points = surface_points(body, faces, shares)
    positions = np.einsum("ks,ksc->kc", shares, vertices[body.faces[faces]])
    pixels, depth = view.camera.project(positions)
    good = np.isfinite(pixels).all(axis=1) & (depth > _LEAST_DEPTH)
    if good.sum() < 3:
        return Residuals(_some(points, np.empty(0, int)), np.empty(0), np.empty((0, 3)), np.empty(0))
    tree = cKDTree(np.concatenate([pixels[good], _NORMAL_PIXELS * directions[good]], axis=1))
    near = np.flatnonzero(good)[
        tree.query(np.concatenate([view.contour, _NORMAL_PIXELS * view.normals], axis=1))[1]
    ]
    metres = depth[near] / _focal(view.camera)
    value = np.einsum("mc,mc->m", view.contour - pixels[near], view.normals) * metres
    apart = np.linalg.norm(view.contour - pixels[near], axis=1) * metres
    agree = np.einsum("mc,mc->m", directions[near], view.normals) > _SAME_SIDE
    contact = view.contact
    if contact is None:
        joints = body.skin_weights[body.faces[faces[near], 0]].argmax(axis=1)
        contact = contact_of_joints()[joints]
    contact = np.where(value > 0, np.maximum(contact, least_contact), 1.0)
    weights = agree * contact * _weights(apart, robust, len(view.contour))
    gradients = -_through_camera(view.camera, positions[near], view.normals) * metres[:, None]
    return Residuals(_some(points, near), value, gradients, weights)


def view_misfit(
    body: BodyModel, vertices: Doubles, positions: Doubles, views: list[View], robust: float
) -> float:
    """Misfit to masks, metres²: mean robust distances of contours and of points outside of the masks."""
    total = 0.0
    normals = face_normals(vertices, body.faces)[0]
    for view in views:
        faces, shares, directions = occluding_contour(body, vertices, normals, view.camera)
        contour_positions = np.einsum("ks,ksc->kc", shares, vertices[body.faces[faces]])
        pixels, depth = view.camera.project(contour_positions)
        good = np.isfinite(pixels).all(axis=1)
        metres = float(np.median(depth)) / _focal(view.camera)
        if good.sum() < 3:
            total += 2 * robust**2
            continue
        tree = cKDTree(np.concatenate([pixels[good], _NORMAL_PIXELS * directions[good]], axis=1))
        apart = tree.query(np.concatenate([view.contour, _NORMAL_PIXELS * view.normals], axis=1))[0] * metres
        total += float((apart**2 * robust**2 / (apart**2 + robust**2)).mean())
        spots, _ = view.camera.project(positions)
        visible = view.camera.in_view(spots)
        columns, rows = (np.where(visible, spots[:, axis], 0).astype(int) for axis in (0, 1))
        over = np.where(visible, np.minimum(view.distance[rows, columns], 0) * metres, 0)
        total += float((over**2 * robust**2 / (over**2 + robust**2)).mean())
    return total / len(views)


def occluding_contour(
    body: BodyModel, vertices: Doubles, normals: Doubles, camera: Camera
) -> tuple[NDArray[np.intp], Doubles, Doubles]:
    """The occluding contour: faces (K,), barycentric shares (K, 3) and directions in the image (K, 2).

    The points are the middles of edges between a face that is turned to the camera and one that is not; the
    directions are those of the surface normal in the image, pointing out of the body.
    """
    edges = _edges(body)
    towards = camera.centre - vertices[body.faces[:, 0]]
    facing = np.einsum("fc,fc->f", normals, towards) > 0
    first, second = edges[:, 0], edges[:, 1]
    turning = facing[first] != facing[second]
    faces, corner = first[turning], edges[turning, 2]
    shares = np.full((len(faces), 3), 0.5)
    shares[np.arange(len(faces)), (corner + 2) % 3] = 0.0
    across = (normals[faces] + normals[second[turning]]) @ camera.camera_from_world[:3, :3].T
    flat = across[:, :2] / np.maximum(np.linalg.norm(across[:, :2], axis=1, keepdims=True), 1e-9)
    return faces, shares, flat


def _mask_distance(positions: Doubles, view: View) -> tuple[Doubles, Doubles, tuple[NDArray, NDArray]]:
    """Metres (K,) inside of a mask, 0 out of view; metres per pixel (K,); rows and columns, each (K,)."""
    pixels, depth = view.camera.project(positions)
    visible = view.camera.in_view(pixels) & (depth > _LEAST_DEPTH)
    columns, rows = (np.where(visible, pixels[:, axis], 0).astype(int) for axis in (0, 1))
    metres = np.where(visible, depth, 1.0) / _focal(view.camera)
    return np.where(visible, view.distance[rows, columns] * metres, 0.0), metres, (rows, columns)


def _edges(body: BodyModel) -> NDArray[np.intp]:
    """(E, 3): two faces that share an edge, and the corner of the first at which the edge begins."""
    if body.digest not in _EDGES:
        faces = body.faces
        begins = faces.reshape(-1).astype(np.int64)
        ends = faces[:, [1, 2, 0]].reshape(-1).astype(np.int64)
        key = np.minimum(begins, ends) * (int(faces.max()) + 1) + np.maximum(begins, ends)
        order = np.argsort(key, kind="stable")
        same = key[order[:-1]] == key[order[1:]]
        one, other = order[:-1][same], order[1:][same]
        _EDGES.clear()  # one model is in use at a time
        _EDGES[body.digest] = np.stack([one // 3, other // 3, one % 3], axis=1)
    return _EDGES[body.digest]


def _through_camera(camera: Camera, positions: Doubles, slopes: NDArray) -> Doubles:
    """(K, 3) derivative by the world point of slopes (K, 2) · pixel."""
    in_camera = positions @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    depth = in_camera[:, 2]
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    x, y = slopes[:, 0] * fx / depth, slopes[:, 1] * fy / depth
    z = -(x * in_camera[:, 0] + y * in_camera[:, 1]) / depth
    return np.stack([x, y, z], axis=1) @ camera.camera_from_world[:3, :3]


def _weights(distance: Doubles, robust: float, count: int) -> Doubles:
    noise = max(_NOISE_M, _NOISE_SHARE * robust)
    return (robust**2 / (robust**2 + distance**2)) ** 2 * _MEASUREMENTS / (noise**2 * max(count, 1))


def _some(points: SurfacePoints, rows: NDArray[np.intp]) -> SurfacePoints:
    return SurfacePoints(points.rest[rows], points.directions[rows], points.weights[rows])


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.intrinsics[0, 0] * camera.intrinsics[1, 1]))
