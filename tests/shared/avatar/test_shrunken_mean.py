"""The share of the training's mean that poses unlike the training's take."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.shared.avatar.decoders.pose_prior import shrunken_mean


def residuals(offsets: np.ndarray) -> torch.Tensor:
    """(T, N, 14) with these offsets (T, N, 3) and other channels that count up."""
    others = np.broadcast_to(np.arange(11.0), (*offsets.shape[:2], 11))
    return torch.from_numpy(np.concatenate([offsets, others], axis=2)).float()


def chosen_by_hand(offsets: np.ndarray) -> float:
    """The same choice, written with lists of frames."""
    errors = {}
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        total = 0.0
        for part in np.array_split(np.arange(len(offsets)), 4):
            rest = np.setdiff1d(np.arange(len(offsets)), part)
            apart = offsets[part] - share * offsets[rest].mean(axis=0)
            total += np.linalg.norm(apart, axis=2).mean(axis=1).sum()
        errors[share] = total
    return min(errors, key=lambda share: errors[share])


@pytest.mark.parametrize("drift", [0.0, 0.3, 1.0, 3.0])
def test_share_is_that_of_leaving_out_quarters(drift: float) -> None:
    generator = np.random.default_rng(3)
    direction = generator.normal(size=(1, 20, 3))
    turning = np.sin(np.linspace(0.0, 2 * np.pi, 16))[:, None, None] * generator.normal(size=(1, 20, 3))
    offsets = direction + drift * turning
    values = residuals(offsets)
    mean, share = shrunken_mean(lambda index: values[index], len(values))
    assert share == chosen_by_hand(offsets)
    assert torch.allclose(mean[:, :3], share * values.mean(dim=0)[:, :3], atol=1e-6)
    assert torch.allclose(mean[:, 3:], values.mean(dim=0)[:, 3:])


def test_cloth_that_always_hangs_the_same_keeps_its_whole_mean() -> None:
    values = residuals(np.ones((8, 5, 3)))
    assert shrunken_mean(lambda index: values[index], 8)[1] == 1.0


def test_a_mean_that_the_rest_of_the_take_contradicts_is_not_trusted() -> None:
    swing = np.repeat([1.0, -1.0, 1.0, -1.0], 4)[:, None, None] * np.ones((1, 5, 3)) + 0.01
    values = residuals(swing)
    assert shrunken_mean(lambda index: values[index], 16)[1] == 0.0


def test_too_few_poses_keep_the_mean() -> None:
    values = residuals(np.random.default_rng(0).normal(size=(3, 5, 3)))
    mean, share = shrunken_mean(lambda index: values[index], 3)
    assert share == 1.0 and torch.allclose(mean, values.mean(dim=0), atol=1e-6)
