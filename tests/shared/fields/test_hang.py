"""Cloth between the legs hangs from the pelvis."""

from __future__ import annotations

import numpy as np
import pytest

from stages.shared.fields.body_field import bias_to_pelvis


def row(pelvis: float = 0.0, left: float = 0.0, right: float = 0.0, spine: float = 0.0) -> np.ndarray:
    values = np.zeros(58)
    values[[0, 4, 2, 3]] = pelvis, left, right, spine
    values[55:] = 7.0, 8.0, 9.0  # other channels
    return values


def test_nothing_changes_on_one_leg_or_off_the_legs() -> None:
    values = np.stack([row(left=1.0), row(0.3, right=0.7), row(spine=1.0)])
    np.testing.assert_allclose(bias_to_pelvis(values, 0.5), values, atol=1e-12)


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_halfway_gives_its_share_and_sums_and_other_channels_stay(share: float) -> None:
    values = np.stack([row(left=0.5, right=0.5), row(0.2, left=0.6, right=0.2)])
    found = bias_to_pelvis(values, share)
    assert found[0, 0] == pytest.approx(share)
    assert found[0, 4] == found[0, 2] == pytest.approx(0.5 * (1 - share))
    np.testing.assert_allclose(found[:, :55].sum(axis=1), 1.0)
    np.testing.assert_array_equal(found[:, 55:], values[:, 55:])
    assert found[1, 0] == pytest.approx(0.2 + share * 4 * 0.6 * 0.2 / 0.8 * 0.8)


def test_threads_across_the_middle_stretch_less_when_the_legs_part() -> None:
    across = np.linspace(0, 1, 21)
    values = np.stack([row(left=1 - t, right=t) for t in across])

    def largest_step(weights: np.ndarray) -> float:
        moved = weights[:, 2] - weights[:, 4]  # the right leg goes one way, the left the other
        return float(np.diff(moved)[8:12].max())

    assert largest_step(bias_to_pelvis(values, 0.15)) < 0.9 * largest_step(values)


def test_bodies_with_other_joints_are_left_alone() -> None:
    values = np.full((3, 8), 1 / 8)
    assert bias_to_pelvis(values, 0.5) is values
