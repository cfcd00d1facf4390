"""Optical flow as a pull on positions: it finds a known shift and moves what is seen the right way."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from stages.shared.losses.flow import dense_flow, flow_loss


def _texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).random((90, 80)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3)
    smooth = (smooth - smooth.min()) / (smooth.max() - smooth.min())
    return np.repeat(smooth[..., None], 3, axis=2)


def test_flow_finds_a_shift() -> None:
    image = _texture()
    shifted = np.roll(image, (2, 5), axis=(0, 1))
    flow, trusted = dense_flow(torch.from_numpy(image), torch.from_numpy(shifted))
    inner = (slice(15, 75), slice(15, 65))
    assert trusted[inner].float().mean() > 0.9
    assert np.abs(flow[inner].mean(dim=(0, 1)).numpy() - [5, 2]).max() < 0.3


def test_pictures_without_anything_in_common_are_not_trusted() -> None:
    _, trusted = dense_flow(torch.from_numpy(_texture(1)), torch.from_numpy(_texture(2)))
    assert trusted.float().mean() < 0.6


def test_tiny_pictures_give_no_flow() -> None:
    flow, trusted = dense_flow(torch.zeros(8, 9, 3), torch.ones(8, 9, 3))
    assert flow.shape == (8, 9, 2) and not trusted.any()


def test_loss_is_the_distance_in_metres_and_pulls_along_the_flow() -> None:
    intrinsics = torch.tensor([[100.0, 0, 20], [0, 100, 20], [0, 0, 1]])
    means = torch.tensor(
        [[0.0, 0, 2], [0.1, 0, 2], [0.1, 0.1, 2.5], [0, 0, -1], [9, 0, 2]], requires_grad=True
    )
    depth, trusted = torch.full((40, 40), 2.0), torch.ones(40, 40, dtype=torch.bool)
    flow = torch.zeros(40, 40, 2)
    flow[..., 0] = 3.0
    loss = flow_loss(means, torch.eye(4), intrinsics, depth, flow, trusted)
    assert abs(loss.item() - 3 * 2 / 100) < 1e-3, "3 px at 2 m and 100 px of focal length"
    loss.backward()
    assert (means.grad[:2, 0] < 0).all() and means.grad[:2, 1].abs().max() < 1e-6
    assert means.grad[2:].abs().sum() == 0, "hidden, behind the camera, outside"


def test_nothing_trusted_is_zero_with_a_finite_gradient() -> None:
    means = torch.tensor([[0.0, 0, 2]], requires_grad=True)
    nothing = torch.zeros(40, 40, dtype=torch.bool)
    loss = flow_loss(
        means, torch.eye(4), torch.eye(3), torch.full((40, 40), 2.0), torch.ones(40, 40, 2), nothing
    )
    loss.backward()
    assert loss.item() == 0 and torch.isfinite(means.grad).all()
