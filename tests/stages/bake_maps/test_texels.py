"""Map casting on shapes whose maps are known."""

from __future__ import annotations

import numpy as np
import pytest

from stages.bake_maps.grid import Grid
from stages.bake_maps.peel import sphere_directions, surface_points, unseen_shares
from stages.bake_maps.picture import maps_picture
from stages.bake_maps.texels import Texels, cast_texels
from stages.shared.errors import BadData
from stages.shared.texel_maps import initial_sigma, neighbour_texels, seam_pairs, texel_numbers

RADIUS = 0.3


def sphere(rings: int = 48, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), radius: float = RADIUS):
    """A closed sphere: vertices (V, 3), faces (F, 3) facing outward."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1]
    around = np.arange(2 * rings) * np.pi / rings
    ring = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.cos(polar), np.ones_like(around)),
            np.outer(np.sin(polar), np.sin(around)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([ring, [[0, 1, 0], [0, -1, 0]]]) * radius + np.array(centre)
    faces, columns = [], 2 * rings
    for i in range(len(polar) - 1):
        for j in range(columns):
            a, b = i * columns + j, i * columns + (j + 1) % columns
            faces += [[a, b, a + columns], [b, b + columns, a + columns]]
    top, bottom, last = len(ring), len(ring) + 1, (len(polar) - 1) * columns
    for j in range(columns):
        faces += [[top, (j + 1) % columns, j], [bottom, last + j, last + (j + 1) % columns]]
    return vertices, np.array(faces)


def tube(radius: float, low: float, high: float, columns: int = 96):
    """An open vertical tube, both ends open."""
    angle = np.arange(columns) * 2 * np.pi / columns
    ring = np.stack([radius * np.cos(angle), np.zeros(columns), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([ring + [0, high, 0], ring + [0, low, 0]])
    a = np.arange(columns)
    b = (a + 1) % columns
    faces = np.concatenate([np.stack([a, b, a + columns], 1), np.stack([b, b + columns, a + columns], 1)])
    return vertices, faces


def grid(pitch: float = 0.01) -> Grid:
    return Grid.around(np.array([[-0.9, -0.9, -0.1], [0.9, 0.9, 0.1]]), pitch, 2.0)


def baked(vertices: np.ndarray, faces: np.ndarray, pitch: float = 0.01):
    """Texels with positions, neighbours and seams of a sphere-like mesh whose normals are radial."""
    texels = cast_texels(vertices, faces, grid(pitch), "upper")
    positions = texels.interpolate(faces, vertices)
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    numbers = texel_numbers(texels.texels, texels.window)
    neighbours = neighbour_texels(numbers, texels.texels, texels.window, positions[:, 2], 0.03)
    return texels, positions, normals, neighbours, seam_pairs(numbers, neighbours, positions, normals, 0.12)


def test_texels_of_a_sphere_lie_on_it_at_their_grid_places() -> None:
    vertices, faces = sphere()
    texels, positions, _, _, _ = baked(vertices, faces)
    distance = np.linalg.norm(positions, axis=1)
    assert distance.max() <= RADIUS + 1e-6
    assert distance.min() > RADIUS * np.cos(np.pi / 48) ** 2 - 1e-6  # chords of the facets
    expected = grid().positions(texels.texels[:, 1], texels.texels[:, 2])
    np.testing.assert_allclose(positions[:, :2], expected, atol=2e-6)
    front = texels.texels[:, 0] == 0
    assert (positions[front, 2] > -1e-3).all() and (positions[~front, 2] < 1e-3).all()


def test_number_of_texels_is_the_silhouette_area() -> None:
    texels, *_ = baked(*sphere())
    assert len(texels.texels) == pytest.approx(2 * np.pi * RADIUS**2 / 0.01**2, rel=0.02)
    front, back = (texels.texels[texels.texels[:, 0] == view, 1:] for view in (0, 1))
    np.testing.assert_array_equal(front, back)


def test_order_is_view_row_column_and_ids_are_unique() -> None:
    texels, *_ = baked(*sphere())
    view, row, column = texels.texels.astype(np.int64).T
    key = (view * 1000 + row) * 1000 + column
    assert (np.diff(key) > 0).all()
    row0, column0, height, width = texels.window
    assert row.min() >= row0 and row.max() < row0 + height
    assert column.min() >= column0 and column.max() < column0 + width
    assert height == pytest.approx(2 * RADIUS / 0.01, abs=2)


def test_neighbours_are_mutual_and_one_pitch_away() -> None:
    texels, _, _, neighbours, _ = baked(*sphere())
    steps = np.array([[-1, 0], [0, 1], [1, 0], [0, -1]])
    for direction, step in enumerate(steps):
        there = np.flatnonzero(neighbours[:, direction] >= 0)
        other = neighbours[there, direction]
        np.testing.assert_array_equal(
            texels.texels[other, 1:] - texels.texels[there, 1:], step[None].repeat(len(there), 0)
        )
        np.testing.assert_array_equal(neighbours[other, (direction + 2) % 4], there)
    assert (neighbours >= 0).sum(axis=1).mean() > 3.7


def test_depth_jumps_cut_links() -> None:
    back_vertices, back_faces = sphere(centre=(0, 0, -0.5))
    vertices, faces = sphere(radius=0.1)
    joined = np.concatenate([back_vertices, vertices])
    texels, positions, _, neighbours, _ = baked(
        joined, np.concatenate([back_faces, faces + len(back_vertices)])
    )
    for direction in range(4):
        there = np.flatnonzero(neighbours[:, direction] >= 0)
        jump = np.abs(positions[neighbours[there, direction], 2] - positions[there, 2])
        assert jump.max() <= 0.03
    front = texels.texels[:, 0] == 0
    near = front & (positions[:, 2] > -0.11)
    cut = neighbours[near] < 0
    assert cut.any(), "the small sphere's rim is not linked to the large one behind it"


def test_seams_join_front_and_back_of_one_pixel_all_around_the_silhouette() -> None:
    texels, positions, _, _, seams = baked(*sphere(radius=0.15))
    front, back = seams.T
    assert (texels.texels[front, 0] == 0).all() and (texels.texels[back, 0] == 1).all()
    np.testing.assert_array_equal(texels.texels[front, 1:], texels.texels[back, 1:])
    angle = np.sort(np.arctan2(positions[front, 1], positions[front, 0]))
    assert np.diff(angle).max() < 0.2
    inside = np.pad(texel_numbers(texels.texels, texels.window)[0] >= 0, 1)
    whole = inside[1:-1, :-2] & inside[1:-1, 2:] & inside[:-2, 1:-1] & inside[2:, 1:-1]
    silhouette = np.count_nonzero(inside[1:-1, 1:-1] & ~whole)
    assert len(seams) > 0.8 * silhouette


def test_an_open_hem_is_not_sewn_up() -> None:
    vertices, faces = tube(0.03, -0.3, 0.3)
    texels = cast_texels(vertices, faces, grid(), "lower")
    positions = texels.interpolate(faces, vertices)
    normals = positions * [1, 0, 1] / np.linalg.norm(positions[:, [0, 2]], axis=1, keepdims=True)
    numbers = texel_numbers(texels.texels, texels.window)
    neighbours = neighbour_texels(numbers, texels.texels, texels.window, positions[:, 2], 0.03)
    seams = seam_pairs(numbers, neighbours, positions, normals, 0.12)
    middle = np.abs(positions[seams[:, 0], 0]) < 0.01
    assert len(seams) > 0 and not middle.any()


def test_sigma_grows_with_the_slope_up_to_the_cap() -> None:
    normals = np.array([[0, 0, 1.0], [0, 0, -1.0], [0.6, 0, 0.8], [1.0, 0, 0]])
    np.testing.assert_allclose(initial_sigma(normals, 0.01, 0.6, 5.0), [0.006, 0.006, 0.0075, 0.03])


def test_inner_parts_get_no_texels() -> None:
    shell, shell_faces = sphere(radius=0.3)
    core, core_faces = sphere(rings=24, radius=0.2)
    texels = cast_texels(
        np.concatenate([shell, core]), np.concatenate([shell_faces, core_faces + len(shell)]), grid(), "body"
    )
    assert (texels.face < len(shell_faces)).all()


def test_overflow_is_refused_and_says_how_far() -> None:
    vertices, faces = sphere(centre=(0.8, 0.0, 0.0))
    with pytest.raises(BadData, match=r"left 0\.100 m"):
        cast_texels(vertices, faces, grid(), "lower")
    vertices, faces = sphere(centre=(0.0, -0.9, 0.0))
    with pytest.raises(BadData, match=r"bottom 0\.200 m.*--extent 2\.4"):
        cast_texels(vertices, faces, grid(), "lower")


def test_texel_centres_of_the_grid() -> None:
    small = Grid(4, 0.5, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(
        small.positions(np.array([0, 3]), np.array([0, 3])), [[0.25, 2.75], [1.75, 1.25]]
    )
    assert Grid.around(np.zeros((1, 3)), 2 / 1024, 2.0).size == 1024
    assert Grid.around(np.zeros((1, 3)), 0.0065, 2.0).size == 308


def test_unseen_share_of_known_shapes() -> None:
    assert unseen_shares(*sphere())[0] < 0.01
    ball, ball_faces = sphere(rings=24, radius=0.1)
    plates = [
        np.array([[-1, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]]) * [0.2, 0.2, 1] for z in (0.15, -0.15)
    ]
    vertices = np.concatenate([ball, *plates])
    corner = len(ball)
    quads = np.array([[0, 1, 2], [0, 2, 3]])
    faces = np.concatenate([ball_faces, quads + corner, quads + corner + 4])
    ball_area, plates_area = 4 * np.pi * 0.1**2, 2 * 0.4**2
    assert unseen_shares(vertices, faces)[0] == pytest.approx(ball_area / (ball_area + plates_area), rel=0.1)


def test_surface_points_are_even_by_area() -> None:
    vertices, faces = sphere()
    points, normals = surface_points(vertices, faces, 20_000)
    upper = (points[:, 1] > RADIUS / 2).mean()
    assert upper == pytest.approx(0.25, abs=0.01)  # a cap of height r/2 has a quarter of the area
    assert np.einsum("nk,nk->n", points, normals).min() > 0
    np.testing.assert_allclose(np.linalg.norm(sphere_directions(24), axis=1), 1.0)


def test_same_mesh_same_bytes_and_a_picture() -> None:
    vertices, faces = sphere(rings=16)
    first, second = (cast_texels(vertices, faces, grid(0.02), "upper") for _ in range(2))
    assert isinstance(first, Texels)
    assert first.texels.tobytes() == second.texels.tobytes()
    assert first.barycentric.tobytes() == second.barycentric.tobytes()
    grey = np.full((len(first.texels), 3), 0.5)
    picture = maps_picture([(first, grey, grey)])
    assert picture.dtype == np.uint8 and picture.shape[2] == 3
    assert (picture == 128).any() and (picture == 255).any()
