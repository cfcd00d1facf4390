"""Hidden cloth lies on the body at the distance of the visible part."""

from __future__ import annotations

import numpy as np

from stages.segment_layers.hidden_cloth import BodySurface, continued_distance, lower_onto_body

AROUND, ALONG = 48, 12


def tube(radius: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """An open tube around the y axis, faces outward; `radius` (AROUND,) m by azimuth."""
    azimuth = 2 * np.pi * np.arange(AROUND) / AROUND
    circle = np.stack([np.sin(azimuth), np.zeros(AROUND), np.cos(azimuth)], axis=1)
    circle *= np.broadcast_to(radius, AROUND)[:, None]
    vertices = np.concatenate([circle + [0, 0.04 * row, 0] for row in range(ALONG)])
    first = (AROUND * np.arange(ALONG - 1)[:, None] + np.arange(AROUND)).ravel()
    right = np.where(first % AROUND == AROUND - 1, first - AROUND + 1, first + 1)
    lower = np.stack([first, right, right + AROUND], axis=1)
    return vertices, np.concatenate([lower, np.stack([first, right + AROUND, first + AROUND], axis=1)])


def tube_body() -> BodySurface:
    """A tube of radius 10 cm whose canonical copy stands 1 m higher; upper half on joint 9, lower on 6."""
    vertices, faces = tube(0.10)
    weights = np.zeros((len(vertices), 55), np.float32)
    upper = vertices[:, 1] > 0.2
    weights[upper, 9] = weights[~upper, 6] = 1
    directions = np.broadcast_to(vertices[:, None] * 0.1, (len(vertices), 10, 3)).astype(np.float32)
    return BodySurface(vertices, vertices + [0, 1, 0], faces, weights, directions)


def cover() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A shirt 1 cm from the body in front; behind, the jacket over it stands off up to 9 cm."""
    azimuth = 2 * np.pi * np.arange(AROUND) / AROUND
    hidden = np.cos(azimuth) < 0
    vertices, faces = tube(0.11 - 0.08 * np.minimum(np.cos(azimuth), 0))
    return vertices, faces, np.tile(hidden, ALONG)


def lowered(vertices: np.ndarray, faces: np.ndarray, hidden: np.ndarray):  # type: ignore[no-untyped-def]
    canonical = {
        "vertices": (vertices + [0, 1, 0]).astype(np.float32),
        "skin_weights": np.full((len(vertices), 55), 1 / 55, np.float32),
        "shape_directions": np.zeros((len(vertices), 10, 3), np.float32),
    }
    return canonical, lower_onto_body(vertices, canonical, faces, hidden, tube_body())


def test_hidden_cloth_takes_the_distance_of_the_visible_part() -> None:
    vertices, faces, hidden = cover()
    canonical, cloth = lowered(vertices, faces, hidden)
    radius = np.hypot(cloth.world[:, 0], cloth.world[:, 2])
    np.testing.assert_allclose(radius[hidden], 0.11, atol=1.5e-3)
    np.testing.assert_array_equal(cloth.world[~hidden], vertices[~hidden])
    np.testing.assert_array_equal(cloth.canonical[~hidden], canonical["vertices"][~hidden])
    np.testing.assert_allclose(cloth.canonical[hidden], cloth.world[hidden] + [0, 1, 0], atol=1e-5)
    assert not cloth.folded.any()


def test_hidden_cloth_moves_with_the_body_below_it() -> None:
    vertices, faces, hidden = cover()
    _, cloth = lowered(vertices, faces, hidden)
    far = hidden & (np.hypot(vertices[:, 0], vertices[:, 2]) > 0.13)
    above, below = far & (vertices[:, 1] > 0.25), far & (vertices[:, 1] < 0.15)
    np.testing.assert_allclose(cloth.skin_weights[above, 9], 1, atol=1e-6)
    np.testing.assert_allclose(cloth.skin_weights[below, 6], 1, atol=1e-6)
    assert (cloth.shape_directions[far] != 0).any()
    np.testing.assert_allclose(cloth.skin_weights[~hidden], 1 / 55)


def test_cloth_nearer_than_the_visible_part_stays() -> None:
    vertices, faces, hidden = cover()
    near = vertices.copy()
    near[hidden] *= np.where(np.arange(3) == 1, 1.0, 0.104 / np.hypot(*near[hidden][:, [0, 2]].T)[:, None])
    _, cloth = lowered(near, faces, hidden)
    np.testing.assert_array_equal(cloth.world, near)


def test_a_flap_that_folds_over_itself_is_named() -> None:
    vertices, faces, hidden = cover()
    flap = hidden[faces].all(axis=1)
    inside_out = faces.copy()
    inside_out[flap] = faces[flap][:, ::-1]
    _, cloth = lowered(vertices, inside_out, hidden)
    far = np.hypot(vertices[:, 0], vertices[:, 2])[faces].min(axis=1) > 0.13
    assert cloth.folded[flap & far].all() and not cloth.folded[~flap].any()


def test_distance_is_continued_harmonically() -> None:
    """Along a strip with both ends visible, the harmonic continuation is a straight line."""
    count = 21
    x = np.arange(count) * 0.01
    vertices = np.concatenate([np.stack([x, np.full(count, y), np.zeros(count)], axis=1) for y in (0, 0.01)])
    first = np.arange(count - 1)
    faces = np.concatenate(
        [
            np.stack([first, first + 1, first + count], 1),
            np.stack([first + count + 1, first + count, first + 1], 1),
        ]
    )
    visible = (vertices[:, 0] < 0.005) | (vertices[:, 0] > 0.195)
    distance = np.where(vertices[:, 0] < 0.005, 0.01, 0.03)
    result = continued_distance(vertices, faces, distance, ~visible)
    np.testing.assert_allclose(result, 0.01 + vertices[:, 0] * 0.1, atol=2e-3)
    np.testing.assert_array_equal(
        continued_distance(vertices, faces, distance, np.zeros(2 * count, bool)), distance
    )
