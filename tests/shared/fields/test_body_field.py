"""The field of weights and shape directions around a body, on a body made of two legs."""

from __future__ import annotations

import numpy as np
import pytest

from stages.shared.fields.body_field import BodyField, FieldConfig, build_body_field

JOINTS = 55
LEFT, RIGHT, HAND = 1, 2, 30


def tube(centre_x: float, radius: float, count: int = 900, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward normals of a vertical tube around (centre_x, ·, 0), 0 ≤ y ≤ 0.8 m."""
    generator = np.random.default_rng(seed)
    angle, height = generator.uniform(0, 2 * np.pi, count), generator.uniform(0, 0.8, count)
    normals = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], axis=1)
    return normals * radius + np.stack([np.full(count, centre_x), height, np.zeros(count)], axis=1), normals


def two_legs(hand: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    left, left_normals = tube(0.12, 0.05)
    right, right_normals = left * [-1, 1, 1], left_normals * [-1, 1, 1]
    weights = np.zeros((len(left) * 2, JOINTS))
    weights[: len(left), LEFT] = 1
    weights[len(left) :, RIGHT] = 1
    vertices, normals = np.concatenate([left, right]), np.concatenate([left_normals, right_normals])
    if hand:
        finger, finger_normals = tube(0.6, 0.008, 200, seed=1)
        vertices, normals = np.concatenate([vertices, finger]), np.concatenate([normals, finger_normals])
        weights = np.concatenate([weights, np.eye(JOINTS)[[HAND] * len(finger)]])
    directions = np.einsum("vk,b->vkb", vertices, np.arange(1.0, 11.0)) * 0.01
    return vertices, normals, weights, directions


@pytest.mark.parametrize("spread", ["nearest", "inverse", "wide"])
def test_weights_are_a_partition_of_one_everywhere(spread: str) -> None:
    vertices, normals, weights, directions = two_legs()
    field = build_body_field(
        vertices, normals, weights, directions, vertices * 1.2, FieldConfig(resolution=20, spread=spread)
    )
    points = np.random.default_rng(3).normal(scale=1.0, size=(400, 3))
    found, found_directions = field.sample(points)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-9)
    assert found.min() >= 0
    assert found_directions.shape == (400, 3, 10)
    assert np.isfinite(found_directions).all()


def test_equal_values_stay_equal() -> None:
    vertices, normals, weights, directions = two_legs()
    weights[:] = weights.mean(axis=0)
    directions[:] = 0.03
    config = FieldConfig(resolution=24, pelvis_bias=0.0)
    field = build_body_field(vertices, normals, weights, directions, vertices[:0], config)
    found, found_directions = field.sample(vertices * 1.1)
    np.testing.assert_allclose(found, np.broadcast_to(weights[0], found.shape), atol=1e-5)
    np.testing.assert_allclose(found_directions, 0.03, atol=1e-5)


def test_wide_spread_bridges_the_gap_between_legs_and_follows_the_skin() -> None:
    vertices, normals, weights, directions = two_legs()
    across = np.stack([np.linspace(-0.12, 0.12, 49), np.full(49, 0.4), np.full(49, 0.09)], axis=1)
    slopes = {}
    for spread in ("nearest", "wide"):
        config = FieldConfig(resolution=40, spread=spread, margin=0.15, pelvis_bias=0.0)
        field = build_body_field(vertices, normals, weights, directions, across, config)
        left = field.weights(across)[:, LEFT]
        np.testing.assert_allclose(left, 1.0 - left[::-1], atol=0.03)
        slopes[spread] = np.abs(np.diff(left)).max()
        near_skin = field.weights(np.array([[0.12 + 0.051, 0.4, 0.0]]))
        assert near_skin[0, LEFT] > 0.9
    assert slopes["wide"] < 0.5 * slopes["nearest"]


def test_fingers_keep_their_own_weights_and_nothing_far_away_does() -> None:
    vertices, normals, weights, directions = two_legs(hand=True)
    field = build_body_field(vertices, normals, weights, directions, vertices[:0], FieldConfig(resolution=16))
    finger = vertices[-200:]
    np.testing.assert_allclose(field.weights(finger)[:, HAND], 1.0, atol=1e-5)
    assert field.weights(np.array([[0.12, 0.4, 0.06]]))[0, HAND] < 1e-3


def test_same_input_same_bytes_and_arrays_round_trip() -> None:
    parts = two_legs(hand=True)
    first, second = (
        build_body_field(*parts, parts[0], FieldConfig(resolution=20)).to_arrays() for _ in range(2)
    )
    assert {name: array.tobytes() for name, array in first.items()} == {
        name: array.tobytes() for name, array in second.items()
    }
    field = build_body_field(*parts, parts[0], FieldConfig(resolution=20))
    again = BodyField.from_arrays(first)
    points = np.random.default_rng(5).uniform(-0.3, 0.7, size=(200, 3))
    np.testing.assert_allclose(again.weights(points), field.weights(points), atol=1e-6)


def test_only_a_band_is_computed() -> None:
    vertices, normals, weights, directions = two_legs()
    config = FieldConfig(resolution=48, margin=0.05)
    field = build_body_field(vertices, normals, weights, directions, vertices[:0], config)
    assert len(field.field.values) < 0.8 * 48**3
