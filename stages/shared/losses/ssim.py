"""Structural similarity with an 11×11 Gaussian window, σ = 1.5 px (Wang et al. 2004), zero padding.

C₁ = 0.01², C₂ = 0.03² for values in 0..1; the mean is over pixels and channels. On a CPU in float32 the
filters are OpenCV's and the gradient is written out; elsewhere plain torch convolutions do the same. The
tests hold the two against each other and against finite differences.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from stages.shared.finite import finite

_SIZE, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim_loss(image: Tensor, truth: Tensor) -> Tensor:
    """1 − SSIM of two images (H, W, C), values in 0..1; the truth gets no gradient. Empty images give 0."""
    if image.numel() == 0:
        return image.sum()
    return 1.0 - ssim(image, truth)


def ssim(image: Tensor, truth: Tensor) -> Tensor:
    """Mean structural similarity of two images (H, W, C)."""
    truth = truth.detach()
    if image.device.type == "cpu" and image.dtype == torch.float32:
        mean = _FilteredSsim.apply(image, truth)
    else:
        mean = _index(*(_filtered(part) for part in _moments(image, truth)))[0].mean()
    return finite(mean, "ssim", image=image, truth=truth)


def _moments(image: Tensor, truth: Tensor) -> tuple[Tensor, ...]:
    return image, truth, image * image, truth * truth, image * truth


def _index(
    mean_x: Tensor, mean_y: Tensor, square_x: Tensor, square_y: Tensor, product: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """SSIM per pixel from filtered moments, and its four factors A₁ A₂ / (B₁ B₂)."""
    a1 = 2 * mean_x * mean_y + _C1
    a2 = 2 * (product - mean_x * mean_y) + _C2
    b1 = mean_x * mean_x + mean_y * mean_y + _C1
    b2 = (square_x - mean_x * mean_x) + (square_y - mean_y * mean_y) + _C2
    return (a1 * a2) / (b1 * b2), a1, a2, b1, b2


def _taps(like: Tensor) -> Tensor:
    distance = torch.arange(_SIZE, dtype=like.dtype, device=like.device) - _SIZE // 2
    taps = torch.exp(-0.5 * (distance / _SIGMA) ** 2)
    return taps / taps.sum()


def _filtered(image: Tensor) -> Tensor:
    """Gaussian filter of (H, W, C) with zeros outside, in torch."""
    taps = _taps(image)
    channels = image.permute(2, 0, 1)[:, None]
    channels = functional.conv2d(channels, taps.view(1, 1, -1, 1), padding=(_SIZE // 2, 0))
    channels = functional.conv2d(channels, taps.view(1, 1, 1, -1), padding=(0, _SIZE // 2))
    return channels[:, 0].permute(1, 2, 0)


def _filtered_cv(image: Tensor) -> Tensor:
    """The same with OpenCV, for float32 on the CPU."""
    taps = _taps(image).numpy()
    array = np.ascontiguousarray(image.numpy())
    found = cv2.sepFilter2D(array, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(found.reshape(array.shape))


class _FilteredSsim(torch.autograd.Function):
    """Mean SSIM; the derivatives by the filtered moments are filtered back (the window is symmetric)."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: Tensor) -> Tensor:
        image, truth = image.detach(), truth.detach()
        mean_x, mean_y, *rest = (_filtered_cv(part) for part in _moments(image, truth))
        index, a1, a2, b1, b2 = _index(mean_x, mean_y, *rest)
        ctx.save_for_backward(image, truth, mean_x, mean_y, index, a1, a2, b1, b2)
        return index.mean()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        image, truth, mean_x, mean_y, index, a1, a2, b1, b2 = ctx.saved_tensors
        inverse = 1.0 / (b1 * b2)
        by_square = -index / b2
        by_product = 2 * a1 * inverse
        by_mean = 2 * (mean_y * (a2 - a1) * inverse - mean_x * index / b1 - mean_x * by_square)
        total = _filtered_cv(by_mean)
        total += 2 * image * _filtered_cv(by_square)
        total += truth * _filtered_cv(by_product)
        return total * (gradients[0] / index.numel()), None
