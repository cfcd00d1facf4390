"""Dense optical flow from the render to the image, as a pull on the Gaussians' positions.

Where cloth is several pixels from its place, image gradients only see the next stripe; flow sees the motion.
It is computed on the finished pictures (OpenCV's DIS), held fixed, and says for every visible Gaussian to
which pixel it should go. Flow that does not come back to where it started is not used.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.finite import finite, require_finite

_SMALLEST = 32  # px; DIS needs some room for its patches
_DEPTH_TOLERANCE = 0.03


def dense_flow(source: Tensor, target: Tensor, tolerance: float = 1.5) -> tuple[Tensor, Tensor]:
    """Where each pixel of `source` is in `target`.

    Arguments:
        source, target: (H, W, 3) 0..1. tolerance: px, how far a pixel may come back from where it started.

    Returns:
        flow (H, W, 2) px as x, y, and (H, W) bool: where it can be trusted.
    """
    require_finite("dense_flow", source=source, target=target)
    height, width = source.shape[:2]
    if min(height, width) < _SMALLEST:
        return torch.zeros(height, width, 2), torch.zeros(height, width, dtype=torch.bool)
    first, second = _grey(source), _grey(target)
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    forward = method.calc(first, second, np.zeros((height, width, 2), np.float32))
    backward = method.calc(second, first, np.zeros((height, width, 2), np.float32))
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    back = cv2.remap(backward, columns + forward[..., 0], rows + forward[..., 1], cv2.INTER_LINEAR)
    trusted = np.square(forward + back).sum(axis=2) < tolerance**2
    return torch.from_numpy(forward), torch.from_numpy(trusted)


def flow_loss(
    means: Tensor, viewmat: Tensor, intrinsics: Tensor, depth: Tensor, flow: Tensor, trusted: Tensor
) -> Tensor:
    """Mean distance, in metres at the Gaussian's depth, of visible Gaussians from where the flow takes them.

    Arguments:
        means: (N, 3) m, world. viewmat: (4, 4). intrinsics: (3, 3) px.
        depth: (H, W) m, expected depth of the render, 0 where nothing is. flow: (H, W, 2) px.
        trusted: (H, W) bool.

    A Gaussian counts when it is within 3 cm of the depth seen at its pixel and the flow there is trusted.
    """
    require_finite("flow_loss", means=means, viewmat=viewmat, intrinsics=intrinsics, depth=depth, flow=flow)
    height, width = depth.shape
    in_camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    distance = in_camera[:, 2].clamp(min=1e-3)
    pixels = in_camera[:, :2] / distance[:, None] * intrinsics.diagonal()[:2] + intrinsics[:2, 2]
    here = pixels.detach()
    column, row = here[:, 0].floor(), here[:, 1].floor()
    on_image = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (in_camera[:, 2] > 1e-3)
    index = torch.where(on_image, row * width + column, torch.zeros_like(row)).long()
    seen = (depth.detach().reshape(-1)[index] - distance.detach()).abs() < _DEPTH_TOLERANCE
    counts = on_image & seen & trusted.reshape(-1)[index]
    if not bool(counts.any()):
        return means.sum() * 0.0
    target = here[counts] + flow.reshape(-1, 2)[index[counts]]
    metres = (pixels[counts] - target) * (distance[counts].detach() / intrinsics[0, 0])[:, None]
    cost = (metres.square().sum(dim=1) + 1e-8).sqrt().mean()
    return finite(cost, "flow_loss", means=means, viewmat=viewmat, intrinsics=intrinsics, flow=flow)


def _grey(image: Tensor) -> NDArray[np.uint8]:
    pixels = (image.detach().cpu().clamp(0, 1) * 255).to(torch.uint8).numpy()
    return np.ascontiguousarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
