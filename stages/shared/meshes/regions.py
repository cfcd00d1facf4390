"""Cleaning a labelled mesh: orientation, edges, islands, absent garments, labels of faces."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import components, vertex_normals

_LIFT = 1e-3  # metres from the surface at which rays start
_JOIN = 1e-5  # metres: vertices closer than this are one place, though the mesh stores them twice


def outward_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces (F, 3), those of every inside-out connected piece with their corners swapped.

    From the outside of a surface most rays along the normal leave the scene; from the inside they meet it
    again. A piece is turned when more of its vertices are free behind than before.
    """
    normals = vertex_normals(vertices, faces).astype(np.float64)
    scene = RayScene(vertices, faces)
    before = ~scene.first_hits(vertices + _LIFT * normals, normals).hit
    behind = ~scene.first_hits(vertices - _LIFT * normals, -normals).hit
    piece = components(faces, len(vertices))
    surplus = np.bincount(piece, before.astype(float) - behind)
    inside_out = surplus[piece[faces[:, 0]]] < 0
    return np.where(inside_out[:, None], faces[:, ::-1], faces)


def mesh_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(E, 2) undirected edges of faces (F, 3), u < v, once each, and links between coincident vertices."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    joined = cKDTree(vertices).query_pairs(_JOIN, output_type="ndarray")
    edges = np.sort(np.concatenate([sides, joined.reshape(-1, 2)]), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    return np.unique(edges, axis=0)


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) m²: a third of the area of the faces around each vertex."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return np.bincount(faces.ravel(), np.repeat(area / 3, 3), minlength=len(vertices))


def remove_islands(
    labels: np.ndarray, edges: np.ndarray, areas: np.ndarray, smallest: float, rounds: int = 4
) -> np.ndarray:
    """Give patches of one label smaller than `smallest` m² the label they share most edges with.

    A patch without neighbours of another label (a separate piece of the mesh) keeps its label, however small.
    """
    labels = labels.copy()
    for _ in range(rounds):
        patches, _, patch_areas = _patches(labels, edges, areas)
        if not _absorb(labels, edges, patches, np.flatnonzero(patch_areas < smallest)):
            break
    return labels


def drop_absent(
    labels: np.ndarray, edges: np.ndarray, areas: np.ndarray, garments: tuple[int, ...], share: float
) -> np.ndarray:
    """Dissolve garment labels that cover less than `share` of the area into what is around them."""
    labels = labels.copy()
    for label in garments:
        inside = labels == label
        if not inside.any() or areas[inside].sum() >= share * areas.sum():
            continue
        patches, patch_labels, _ = _patches(labels, edges, areas)
        _absorb(labels, edges, patches, np.flatnonzero(patch_labels == label))
        labels[labels == label] = 0
    return labels


def face_labels(labels: np.ndarray, faces: np.ndarray, outermost: tuple[int, ...]) -> np.ndarray:
    """(F,) label of at least two corners; with three different ones, the one first in `outermost`."""
    corner = labels[faces]
    majority = np.where(corner[:, 1] == corner[:, 2], corner[:, 1], corner[:, 0])
    split = (corner[:, 0] != corner[:, 1]) & (corner[:, 1] != corner[:, 2]) & (corner[:, 0] != corner[:, 2])
    rank = np.full(256, len(outermost))
    rank[list(outermost)] = np.arange(len(outermost))
    first = np.take_along_axis(corner, rank[corner].argmin(axis=1)[:, None], axis=1)[:, 0]
    return np.where(split, first, majority)


def _patches(
    labels: np.ndarray, edges: np.ndarray, areas: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patch number (V,), label (P,) and area (P,) of the connected patches of equal label."""
    same = edges[labels[edges[:, 0]] == labels[edges[:, 1]]]
    graph = sparse.coo_matrix((np.ones(len(same)), (same[:, 0], same[:, 1])), shape=(len(labels),) * 2)
    count, patches = connected_components(graph, directed=False)
    patch_labels = np.zeros(count, dtype=labels.dtype)
    patch_labels[patches] = labels
    return patches, patch_labels, np.bincount(patches, areas, minlength=count)


def _absorb(labels: np.ndarray, edges: np.ndarray, patches: np.ndarray, chosen: np.ndarray) -> bool:
    """Relabel, in place, the chosen patches by the most frequent other label across their border."""
    changed = False
    border = edges[labels[edges[:, 0]] != labels[edges[:, 1]]]
    pairs = np.concatenate([border, border[:, ::-1]])
    inside = np.isin(patches[pairs[:, 0]], chosen)
    pairs = pairs[inside]
    across = labels[pairs[:, 1]].copy()
    patch_of_pair = patches[pairs[:, 0]]
    for patch in chosen:
        around = across[patch_of_pair == patch]
        if len(around):
            labels[patches == patch] = np.bincount(around).argmax()
            changed = True
    return changed
