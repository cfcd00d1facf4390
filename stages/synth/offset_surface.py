"""Even triangle meshes around the body: an offset surface of its signed distance, cut to a region.

Surface nets on a regular grid give nearly equal triangles (Gibson 1998: one vertex per cell that the
surface crosses, at the mean of the crossings, one quad per crossed grid edge). T-shirt, trousers, vest,
hair and shoes are all made this way, in the rest frame of the mean body.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import coo_matrix, csr_matrix

from stages.shared.meshes import boundary_edges, components, edges, keep_faces

Doubles = NDArray[np.float64]
Faces = NDArray[np.int64]
Field = Callable[[Doubles], Doubles]  # (N, 3) m -> (N,) m


class DistanceGrid:
    """Signed distance of a body on a grid with a node plane half a cell off x = 0, so that meshes have
    edges along the body's plane of symmetry."""

    def __init__(
        self,
        vertices: Doubles,
        faces: Faces,
        lower: Doubles,
        upper: Doubles,
        spacing: float,
        blur: float = 0.8,
    ) -> None:
        first = np.floor(np.asarray(lower) / spacing) * spacing
        first[0] -= 0.5 * spacing
        counts = np.ceil((np.asarray(upper) - first) / spacing).astype(int) + 1
        axes = [first[k] + spacing * np.arange(counts[k]) for k in range(3)]
        self.spacing, self.first = spacing, first
        self.nodes: Doubles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        distance = igl.signed_distance(
            self.nodes.reshape(-1, 3), vertices, faces, sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        )[0]
        # A little blur bridges navel, armpit and crotch as cloth does.
        self.values: Doubles = gaussian_filter(distance.reshape(tuple(counts)), blur, mode="nearest")

    def at(self, points: Doubles) -> Doubles:
        """(N,) signed distance, metres, trilinear."""
        coordinates = (points - self.first) / self.spacing
        return map_coordinates(self.values, coordinates.T, order=1, mode="nearest")


def shell(grid: DistanceGrid, offset: Field, inside: Field) -> tuple[Doubles, Faces]:
    """The surface at `offset(p)` metres from the body, where `inside(p)` is negative.

    Arguments:
        offset: distance from the body, (N, 3) -> (N,) metres.
        inside: about a signed distance to the cut, negative on the side that remains.

    Returns:
        vertices (V, 3) rest frame, faces (F, 3) with outward normals; the largest connected piece.
    """
    shape = grid.nodes.shape[:3]
    level = grid.values - offset(grid.nodes.reshape(-1, 3)).reshape(shape)
    vertices, faces = surface_nets(level, grid.first, grid.spacing)

    def level_at(points: Doubles) -> Doubles:
        return grid.at(points) - offset(points)

    faces = faces[inside(vertices[faces].mean(axis=1)) < 0]
    vertices, faces = largest_piece(vertices, _without_spikes(faces))
    for _ in range(6):
        border = border_vertices(len(vertices), faces)
        vertices = _relax(vertices, faces, border)
        vertices[border] = _newton(vertices[border], inside)
        vertices = _newton(vertices, level_at)
    return vertices, faces


def surface_nets(level: Doubles, first: Doubles, spacing: float) -> tuple[Doubles, Faces]:
    """Zero surface of a grid (X, Y, Z): vertices (V, 3) m, faces (F, 3), normals towards positive."""
    negative = level < 0
    sums = np.zeros(tuple(n - 1 for n in level.shape) + (3,))
    crossings = np.zeros(tuple(n - 1 for n in level.shape))
    for axis in range(3):
        low, high = _pair(level, axis)
        crossed = (low < 0) != (high < 0)
        gap = np.where(crossed, low - high, 1.0)
        where = np.indices(low.shape).transpose(1, 2, 3, 0).astype(float)
        where[..., axis] += np.where(crossed, low / gap, 0.0)
        for shift in _edge_shifts(axis):
            part = tuple(
                slice(None) if k == axis else slice(s, s + level.shape[k] - 1)
                for k, s in zip(range(3), shift, strict=True)
            )
            sums += np.where(crossed[part][..., None], where[part], 0.0)
            crossings += crossed[part]
    active = crossings > 0
    index = np.full(active.shape, -1, dtype=np.int64)
    index[active] = np.arange(active.sum())
    vertices = first + spacing * sums[active] / crossings[active][:, None]
    quads = [_quads(negative, index, axis) for axis in range(3)]
    return vertices, _split(vertices, np.concatenate(quads))


def border_vertices(count: int, faces: Faces) -> NDArray[np.bool_]:
    """(V,) True on the open border."""
    border = np.zeros(count, dtype=bool)
    border[boundary_edges(faces)] = True
    return border


def neighbour_mean(count: int, pairs: NDArray[np.integer]) -> csr_matrix:
    """(V, V) matrix that averages over the neighbours of a vertex."""
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    matrix = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count)).tocsr()
    degree = np.maximum(np.asarray(matrix.sum(axis=1)).ravel(), 1.0)
    return csr_matrix(matrix.multiply(1.0 / degree[:, None]))


def largest_piece(vertices: Doubles, faces: Faces) -> tuple[Doubles, Faces]:
    """Keep the connected piece with most faces, and only the vertices that faces use."""
    piece = components(faces, len(vertices))[faces[:, 0]]
    remaining, used = keep_faces(faces, piece == np.bincount(piece).argmax(), len(vertices))
    return vertices[used], remaining.astype(np.int64)


def _without_spikes(faces: Faces) -> Faces:
    """Drop triangles that hang on by a single edge, until there are none."""
    while True:
        sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        _, inverse, uses = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
        shared = (uses[inverse.ravel()] > 1).reshape(3, -1).sum(axis=0)
        if np.all(shared > 1):
            return faces
        faces = faces[shared > 1]


def _relax(vertices: Doubles, faces: Faces, border: NDArray[np.bool_]) -> Doubles:
    """Half a step towards the neighbours' mean; border vertices look at border neighbours only."""
    all_edges = edges(faces)
    along = all_edges[border[all_edges].all(axis=1)]
    mean = neighbour_mean(len(vertices), all_edges) @ vertices
    mean_border = neighbour_mean(len(vertices), along) @ vertices
    target = np.where(border[:, None], mean_border, mean)
    return vertices + 0.5 * (target - vertices)


def _newton(points: Doubles, field: Field, step: float = 0.004) -> Doubles:
    """One step along the gradient to the zero of the field, limited to two centimetres."""
    value = field(points)
    gradient = np.stack(
        [(field(points + step * e) - field(points - step * e)) / (2 * step) for e in np.eye(3)], axis=1
    )
    length = np.clip(value / np.maximum((gradient**2).sum(axis=1), 0.1), -0.02, 0.02)
    return points - length[:, None] * gradient


def _pair(level: NDArray[Any], axis: int) -> tuple[NDArray[Any], NDArray[Any]]:
    low = [slice(None)] * 3
    high = [slice(None)] * 3
    low[axis], high[axis] = slice(None, -1), slice(1, None)
    return level[tuple(low)], level[tuple(high)]


def _edge_shifts(axis: int) -> list[tuple[int, int, int]]:
    """The four edges of a cell along an axis, as offsets of their first node."""
    shifts = []
    for a in (0, 1):
        for b in (0, 1):
            shift = [a, b]
            shift.insert(axis, 0)
            shifts.append((shift[0], shift[1], shift[2]))
    return shifts


def _quads(negative: NDArray[np.bool_], index: Faces, axis: int) -> Faces:
    """(Q, 4) cells around each crossed edge along the axis, counter-clockwise seen from outside."""
    before, after = _pair(negative, axis)
    others = [k for k in range(3) if k != axis]
    inner = [slice(None)] * 3
    for k in others:
        inner[k] = slice(1, -1)
    before, after = before[tuple(inner)], after[tuple(inner)]
    corners = []
    for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
        part = [slice(None)] * 3
        for k, s in zip(others, (a, b), strict=True):
            part[k] = slice(s, s + negative.shape[k] - 2)
        corners.append(index[tuple(part)])
    quads = np.stack(corners, axis=-1)
    outward, inward = quads[before & ~after], quads[~before & after][:, ::-1]
    both = (outward, inward) if axis != 1 else (outward[:, ::-1], inward[:, ::-1])
    return np.concatenate(both)


def _split(vertices: Doubles, quads: Faces) -> Faces:
    """Two triangles per quad, along the shorter diagonal."""
    first = np.linalg.norm(vertices[quads[:, 0]] - vertices[quads[:, 2]], axis=1)
    second = np.linalg.norm(vertices[quads[:, 1]] - vertices[quads[:, 3]], axis=1)
    straight = first <= second
    a, b = quads[straight], quads[~straight]
    return np.concatenate([a[:, [0, 1, 2]], a[:, [0, 2, 3]], b[:, [0, 1, 3]], b[:, [1, 2, 3]]])
