"""Picture losses: colour, structure, layer labels, and the silhouette of the body.

Pictures are (H, W, C) with values in 0..1. Every loss is a mean, so it does not depend on the picture's size.
"""

from __future__ import annotations

from typing import Any

import cv2
import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from stages.shared.capture import Camera
from stages.shared.finite import finite

_SIZE, _SIGMA = 11, 1.5  # px, of the SSIM window
_C1, _C2 = 0.01**2, 0.03**2  # SSIM, for values in 0..1


def l1(image: Tensor, truth: Tensor) -> Tensor:
    """Mean of |image − truth| over pixels and channels; both (H, W, C). An empty image gives 0."""
    if image.numel() == 0:
        return image.sum()
    return finite((image - truth).abs().mean(), "l1", image=image, truth=truth)


def ssim_loss(image: Tensor, truth: Tensor) -> Tensor:
    """1 − SSIM of two images (H, W, C), values in 0..1; the truth gets no gradient. Empty images give 0."""
    if image.numel() == 0:
        return image.sum()
    return 1.0 - ssim(image, truth)


def ssim(image: Tensor, truth: Tensor) -> Tensor:
    """Mean structural similarity of two images (H, W, C) over pixels and channels (Wang et al. 2004).

    The window is Gaussian, 11×11, σ = 1.5 px, with zero padding. On a CPU in float32 the filters are OpenCV's
    and the gradient is written out. Elsewhere plain torch convolutions compute the same.
    """
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
    filtered = cv2.sepFilter2D(array, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(filtered.reshape(array.shape))


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


def label_loss(labels: Tensor, truth: Tensor, known: Tensor, kind: str = "l1") -> Tensor:
    """Mean difference of rendered layer labels and the segmentation, over known pixels and channels.

    Arguments:
        labels: (H, W, L) rendered one-hot channels, background 0. truth: (H, W, L) 0 or 1.
        known: (H, W) weight, 0 where the segmentation says nothing. kind: "l1" or "l2" (squared).
    """
    difference = labels - truth
    cost = difference.abs() if kind == "l1" else difference.square()
    mean = (cost.sum(dim=2) * known).sum() / (known.sum().clamp(min=1.0) * max(labels.shape[2], 1))
    return finite(mean, "label_loss", labels=labels, truth=truth, known=known)


def silhouette_loss(body_alpha: Tensor, silhouette: Tensor) -> Tensor:
    """Mean of |Ŝ_b − S_b| over pixels (H, W): the body must fill its silhouette under garments too.

    Arguments:
        body_alpha: of a render of the body alone. silhouette: 0..1, of the body.
    """
    if body_alpha.numel() == 0:
        return body_alpha.sum()
    cost = (body_alpha - silhouette).abs().mean()
    return finite(cost, "silhouette_loss", body_alpha=body_alpha, silhouette=silhouette)


def rasterize_silhouette(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], camera: Camera
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels whose centre a triangle of the mesh covers.

    Arguments:
        vertices: (V, 3) m, world. faces: (F, 3). Triangles that reach behind the camera are left out.
    """
    pixels, _ = camera.project(vertices)
    covered = np.zeros((camera.height, camera.width), dtype=np.bool_)
    _draw(pixels, np.ascontiguousarray(faces, dtype=np.int64), covered)
    return covered


@numba.njit(cache=True, nogil=True)
def _draw(pixels: NDArray[np.float64], faces: NDArray[np.int64], covered: NDArray[np.bool_]) -> None:
    """Set the pixels of every triangle; `pixels` (V, 2) x, y, NaN behind the camera."""
    height, width = covered.shape
    for face in range(faces.shape[0]):
        ax, ay = pixels[faces[face, 0]]
        bx, by = pixels[faces[face, 1]]
        cx, cy = pixels[faces[face, 2]]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 1e-12:  # also NaN
            continue
        left, right = max(0.0, min(ax, bx, cx) - 0.5), min(width - 1.0, max(ax, bx, cx) - 0.5)
        top, bottom = max(0.0, min(ay, by, cy) - 0.5), min(height - 1.0, max(ay, by, cy) - 0.5)
        if left > right or top > bottom:
            continue
        for row in range(int(np.ceil(top)), int(bottom) + 1):
            y = row + 0.5
            for column in range(int(np.ceil(left)), int(right) + 1):
                x = column + 0.5
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                if u >= 0 and v >= 0 and u + v <= 1:
                    covered[row, column] = True
