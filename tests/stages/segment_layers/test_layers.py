"""Tidying labels, cutting layers, filling colours, turning inside-out pieces."""

from __future__ import annotations

import numpy as np
import pytest

from stages.segment_layers.extract import extract_part, join, sink
from stages.segment_layers.fill import fill_colors
from stages.shared.meshes.labelling import (
    known_labels,
    label_costs,
    label_vertices,
    nearest_seen,
    tidy_labels,
)
from stages.shared.meshes.regions import (
    drop_absent,
    face_labels,
    mesh_edges,
    outward_faces,
    remove_islands,
    vertex_areas,
)
from stages.shared.meshes.topology import face_normals

SIDE = 21
PITCH = 0.01


def sheet(side: int = SIDE, pitch: float = PITCH) -> tuple[np.ndarray, np.ndarray]:
    """A flat square grid of vertices (side², 3) and its triangles."""
    y, x = np.mgrid[:side, :side]
    vertices = np.stack([x.ravel() * pitch, y.ravel() * pitch, np.zeros(side * side)], axis=1)
    corner = (y[:-1, :-1] * side + x[:-1, :-1]).ravel()
    lower = np.stack([corner, corner + 1, corner + side], axis=1)
    upper = np.stack([corner + 1, corner + side + 1, corner + side], axis=1)
    return vertices, np.concatenate([lower, upper])


def halves(side: int = SIDE) -> np.ndarray:
    """Label 3 on the left columns, 4 on the right ones."""
    return np.where(np.arange(side * side) % side < side // 2, 3, 4)


def test_vertex_areas_sum_to_the_sheet() -> None:
    vertices, faces = sheet()
    areas = vertex_areas(vertices, faces)
    assert areas.sum() == pytest.approx(((SIDE - 1) * PITCH) ** 2)
    assert areas[5 * SIDE + 5] == pytest.approx(PITCH**2)


def test_islands_dissolve_and_large_patches_stay() -> None:
    vertices, faces = sheet()
    labels = halves()
    labels[5 * SIDE + 3] = 0
    labels[[7 * SIDE + 16, 7 * SIDE + 17]] = 3
    tidy = remove_islands(labels, mesh_edges(vertices, faces), vertex_areas(vertices, faces), 0.001)
    np.testing.assert_array_equal(tidy, halves())


def test_a_separate_piece_keeps_its_label() -> None:
    vertices, faces = sheet(5)
    both = np.concatenate([vertices, vertices + [1.0, 0, 0]])
    labels = np.concatenate([np.full(25, 3), np.full(25, 4)])
    labels[0] = 4
    edges = mesh_edges(both, np.concatenate([faces, faces + 25]))
    tidy = remove_islands(labels, edges, np.full(50, 1e-4), 0.002)
    np.testing.assert_array_equal(tidy, [3] * 25 + [4] * 25)


def test_a_garment_that_is_hardly_there_is_dropped() -> None:
    vertices, faces = sheet()
    labels = np.full(SIDE * SIDE, 3)
    labels[SIDE * 10 + 10] = 5
    edges, areas = mesh_edges(vertices, faces), vertex_areas(vertices, faces)
    assert (drop_absent(labels, edges, areas, (4, 3, 5), 0.005) == 3).all()
    kept = halves()
    np.testing.assert_array_equal(drop_absent(kept, edges, areas, (4, 3, 5), 0.005), kept)


def test_coincident_vertices_are_one_place() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]])
    edges = mesh_edges(vertices, np.array([[0, 1, 2], [3, 4, 5]]))
    assert [1, 3] in edges.tolist()
    assert len(edges) == 7


def test_border_faces_go_to_the_majority_so_that_no_face_is_lost() -> None:
    _, faces = sheet()
    labels = halves()
    by_face = face_labels(labels, faces, (5, 3, 4, 1, 2, 0))
    corners = labels[faces]
    for face, label in zip(corners, by_face, strict=True):
        assert (face == label).sum() >= 2
    split = face_labels(np.array([0, 3, 4]), np.array([[0, 1, 2]]), (5, 3, 4, 1, 2, 0))
    np.testing.assert_array_equal(split, [3])


def test_rings_reach_under_the_neighbour_and_sink() -> None:
    vertices, faces = sheet()
    by_face = face_labels(halves(), faces, (5, 3, 4))
    part = extract_part(faces, by_face == 3, by_face == 4, 2, len(vertices))
    columns = part.vertex_numbers % SIDE
    own = part.ring == 0
    assert columns[own].max() == SIDE // 2 or columns[own].max() == SIDE // 2 - 1
    assert part.ring.max() == 2
    assert columns.max() == columns[own].max() + 2
    assert part.faces.max() < len(part.vertex_numbers)
    sunk = sink(vertices[part.vertex_numbers], np.tile([0, 0, 1.0], (len(part.ring), 1)), part.ring, 0.002)
    np.testing.assert_allclose(sunk[:, 2], -0.002 * part.ring)


def test_joined_meshes_keep_their_triangles() -> None:
    vertices, faces = sheet(3)
    one = {"vertices": vertices, "faces": faces, "labels": np.zeros(9, np.uint8)}
    two = {"vertices": vertices + 5, "faces": faces, "labels": np.ones(9, np.uint8)}
    joined = join([one, two])
    np.testing.assert_allclose(joined["vertices"][joined["faces"][len(faces) :]], (vertices + 5)[faces])
    assert joined["labels"].tolist() == [0] * 9 + [1] * 9


def test_colours_continue_smoothly_and_seen_ones_stay() -> None:
    vertices, faces = sheet()
    column = np.arange(SIDE * SIDE) % SIDE
    confidence = np.isin(column, [0, SIDE - 1]).astype(float)
    colors = np.where(column[:, None] == 0, [1.0, 0.2, 0.0], [0.0, 0.2, 1.0])
    colors[confidence == 0] = 0.7
    filled = fill_colors(vertices, faces, colors, confidence)
    np.testing.assert_allclose(filled[:, 1], 0.2, atol=0.02)
    red = filled[:, 0].reshape(SIDE, SIDE)
    assert red[10, 0] == pytest.approx(1.0, abs=0.05) and red[10, -1] == pytest.approx(0.0, abs=0.05)
    assert red[10, 10] == pytest.approx(0.5, abs=0.05)
    assert (np.diff(red[10]) < 0).all()


def test_a_piece_that_no_image_sees_takes_the_middle_colour() -> None:
    vertices, faces = sheet(4)
    both = np.concatenate([vertices, vertices + 3])
    colors = np.tile([0.3, 0.4, 0.5], (32, 1))
    colors[16:] = 0
    confidence = np.concatenate([np.ones(16), np.zeros(16)])
    filled = fill_colors(both, np.concatenate([faces, faces + 16]), colors, confidence)
    np.testing.assert_allclose(filled, np.tile([0.3, 0.4, 0.5], (32, 1)), atol=1e-3)
    assert np.isfinite(fill_colors(both, faces, colors, np.zeros(32))).all()


def test_noisy_votes_become_two_clean_halves() -> None:
    vertices, faces = sheet()
    truth = halves()
    generator = np.random.default_rng(5)
    noisy = np.where(generator.random(len(truth)) < 0.15, generator.integers(0, 6, len(truth)), truth)
    votes = np.zeros((len(truth), 6))
    votes[np.arange(len(truth)), noisy] = 1.0
    votes[generator.random(len(truth)) < 0.2] = 0.0
    normals = np.tile([0.0, 0, 1], (len(truth), 1))
    cut = label_vertices(vertices, faces, normals, votes, 1.0, 2)
    found = tidy_labels(vertices, faces, cut, (4, 3, 5), 0.001, 0.005)
    assert (noisy != truth).mean() > 0.08
    assert (found == truth).mean() > 0.96
    column = np.arange(len(truth)) % SIDE
    away = np.abs(column - (SIDE // 2 - 0.5)) > 2
    np.testing.assert_array_equal(found[away], truth[away])


def test_unseen_vertices_lean_to_the_nearest_along_the_surface() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 0.1, 0], [9, 9, 9]])
    edges = np.array([[0, 1], [1, 2]])
    seen = np.array([True, False, False, True, False])
    np.testing.assert_array_equal(nearest_seen(vertices, edges, seen), [0, 0, 0, 3, 3])
    votes = np.zeros((5, 2))
    votes[0, 0] = votes[3, 1] = 1.0
    costs = label_costs(vertices, edges, votes)
    np.testing.assert_array_equal(costs.argmin(axis=1), [0, 0, 0, 1, 1])
    assert costs[2].max() < costs[0].max()


def test_missing_scan_labels_take_the_nearest_known() -> None:
    vertices = np.array([[0.0, 0, 0], [0.1, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(known_labels(vertices, np.array([3, 255, 4], np.uint8)), [3, 3, 4])


def test_inside_out_pieces_are_turned_and_only_those() -> None:
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    cube = np.array([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])
    centred = corner - 0.5
    outward = np.einsum("fk,fk->f", face_normals(centred, cube)[0], centred[cube].mean(axis=1))
    assert (outward > 0).all() or (outward < 0).all()
    good = cube if outward[0] > 0 else cube[:, ::-1]
    vertices = np.concatenate([centred, centred + [3.0, 0, 0]])
    faces = np.concatenate([good, good[:, ::-1] + 8])
    turned = outward_faces(vertices, faces)
    np.testing.assert_array_equal(turned[:12], good)
    np.testing.assert_array_equal(turned[12:], good + 8)
