"""Garments go on beneath the ones over them; a dress takes two places."""

from __future__ import annotations

import numpy as np
import pytest

from stages.segment_layers.config import SegmentLayersConfig
from stages.segment_layers.extract import extract_part, faces_beneath
from stages.segment_layers.hidden_cloth import BodySurface
from stages.segment_layers.layers import OUTER, UPPER, Template, garment_layer, slots_of
from stages.shared.layers import GARMENT_LABELS

PITCH = 0.01


def sheet(columns: int, rows: int, z: float = 0.0, left: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A flat grid of squares, cut into triangles that face +z."""
    x, y = np.meshgrid(left + PITCH * np.arange(columns + 1), PITCH * np.arange(rows + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    across, up = corner + 1, corner + columns + 1
    return vertices, np.concatenate(
        [np.stack([corner, across, up + 1], axis=1), np.stack([corner, up + 1, up], axis=1)]
    )


def shirt_and_vest(
    between: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A shirt with a vest to its right, joined or (with `between`) a piece of its own over the border."""
    if not between:
        vertices, faces = sheet(60, 10)
        return vertices, faces, vertices[:, 0] > 0.1005
    shirt, shirt_faces = sheet(12, 10)
    vest, vest_faces = sheet(50, 10, z=between, left=0.1)
    labels = np.concatenate([np.zeros(len(shirt), bool), np.ones(len(vest), bool)])
    return np.concatenate([shirt, vest]), np.concatenate([shirt_faces, vest_faces + len(shirt)]), labels


@pytest.mark.parametrize("between", [0.0, 0.008])
@pytest.mark.parametrize("reach", [0.05, 0.25])
def test_reach_is_measured_along_the_garment_above(between: float, reach: float) -> None:
    vertices, faces, vest = shirt_and_vest(between)
    above = vest[faces].all(axis=1)
    found = faces_beneath(vertices, faces, ~vest[faces].any(axis=1), above, reach)
    assert found.any() and not (found & ~above).any()
    farthest = vertices[faces[found], 0].max()
    assert 0.1 + reach - 2 * PITCH < farthest < 0.1 + reach + 0.045


def test_pieces_that_do_not_come_near_and_nothing_above_give_nothing() -> None:
    vertices, faces, vest = shirt_and_vest(0.2)
    own, above = ~vest[faces].any(axis=1), vest[faces].all(axis=1)
    assert not faces_beneath(vertices, faces, own, above, 0.25).any()
    assert not faces_beneath(vertices, faces, own, np.zeros_like(above), 0.25).any()
    vertices, faces, vest = shirt_and_vest(0.008)
    assert not faces_beneath(vertices, faces, own, above, 0.0).any()


def _template(vertices: np.ndarray, faces: np.ndarray) -> Template:
    count = len(vertices)
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    weights = np.zeros((count, 55), np.float32)
    weights[:, 9] = 1
    canonical = {
        "vertices": vertices.astype(np.float32),
        "skin_weights": weights,
        "shape_directions": np.zeros((count, 10, 3), np.float32),
    }
    return Template(vertices, faces, normals, canonical, normals, None, None)


def _flat_body() -> BodySurface:
    """A plane 2 cm below the shirt."""
    vertices = np.array([[-1.0, -1.0, -0.02], [2.0, -1.0, -0.02], [2.0, 2.0, -0.02], [-1.0, 2.0, -0.02]])
    weights = np.zeros((4, 55), np.float32)
    weights[:, 9] = 1
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return BodySurface(vertices, vertices, faces, weights, np.zeros((4, 10, 3), np.float32))


@pytest.mark.parametrize("between", [0.0, 0.008])
def test_a_shirt_goes_on_under_the_vest_and_not_the_other_way(between: float) -> None:
    vertices, faces, vest = shirt_and_vest(between)
    labels = np.where(vest, OUTER, UPPER).astype(np.uint8)
    config = SegmentLayersConfig(extended_rings=2)
    shirt = garment_layer(_template(vertices, faces), labels, UPPER, config, _flat_body())
    reached = shirt["vertices"][:, 0].max()
    assert 0.3 < reached < 0.4, "a quarter of a metre beneath the vest"
    tucked = shirt["ring"] > 0
    above = between if between else 0.0
    beneath_vest = shirt["vertices"][:, 0] > 0.2
    assert tucked[beneath_vest].all()
    depth = above - shirt["vertices"][beneath_vest, 2]
    expected = max(2 * config.ring_depth_m, between)  # a vest that stands off: the shirt keeps its own height
    np.testing.assert_allclose(depth, expected, atol=1e-5)
    outer = garment_layer(_template(vertices, faces), labels, OUTER, config, _flat_body())
    assert outer["vertices"][:, 0].min() > 0.06, "a vest has no reason to go on under the shirt"
    without = SegmentLayersConfig(beneath_m=0.0, beneath_outer_m=0.0)
    plain = garment_layer(_template(vertices, faces), labels, UPPER, without, _flat_body())
    assert len(plain["faces"]) < len(shirt["faces"])


def test_what_lies_beneath_counts_as_the_last_ring() -> None:
    vertices, faces = sheet(10, 1)
    own = vertices[faces, 0].max(axis=1) < 0.035
    part = extract_part(faces, own, ~own, 1, len(vertices), beneath=~own)
    assert len(part.faces) == len(faces)
    assert part.ring[vertices[part.vertex_numbers, 0] > 0.035].min() == 1
    assert part.ring[vertices[part.vertex_numbers, 0] < 0.025].max() == 0


def _garment(*joints: int) -> dict[str, np.ndarray]:
    weights = np.zeros((10 * len(joints), 55))
    weights[np.arange(len(weights)), np.repeat(joints, 10)] = 1
    return {"skin_weights": weights, "ring": np.zeros(len(weights), np.int32)}


def test_a_dress_takes_two_places_and_separates_take_their_own() -> None:
    body, dress, shirt, skirt = _garment(15), _garment(9, 16, 1, 2), _garment(6, 9, 16), _garment(0, 1, 2)
    assert slots_of({"body": body, "upper": dress}) == {"upper": ["lower", "upper"]}
    assert slots_of({"body": body, "lower": dress}) == {"lower": ["lower", "upper"]}
    assert slots_of({"body": body, "upper": shirt}) == {"upper": ["upper"]}
    assert slots_of({"body": body, "upper": dress, "lower": skirt}) == {
        "upper": ["upper"],
        "lower": ["lower"],
    }
    assert slots_of({"body": body, "outer": dress}) == {"outer": ["outer"]}
    assert GARMENT_LABELS[-1] == OUTER
