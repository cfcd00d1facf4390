"""Normal equations of the texels' displacements: from dense flow, and from collisions with the body.

Flow goes from the render to the picture. Stripes tell how far they moved across their gradient and nothing
along it. Every flow vector is therefore weighted with the picture's structure tensor, so that the solution is
free where the picture has no texture (Lucas and Kanade 1981; Förstner's structure tensor).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from stages.shared.avatar.deform import PosedGaussians
from stages.shared.capture import Camera

Floats = NDArray[np.float64]
_SMALLEST = 32  # px; DIS needs some room for its patches
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
_TEXTURE = 0.6  # share of the grey levels for texture; labels take the rest
_WINDOW = 1.5  # px, of the structure tensor
_NOISE = 30.0  # (grey levels per pixel)², gradients below say little
_RETURN = 2.0  # px², how far flow may come back from where it started
_LARGE = 64.0  # px²; larger flow counts less
_DEPTH_TOLERANCE = 0.02  # m
_CLEARANCE = 0.004  # m between a garment's Gaussians and the body's
_REACH = 0.05  # m; deeper penetrations are not resolved
_NEAREST = 4  # body texels that are averaged


@dataclass(frozen=True)
class Flow:
    """Flow from a render to a picture.

    Attributes:
        vectors: (H·W, 2) px. trust: (H·W,) 0..1.
        tensor: (H·W, 3) structure tensor xx, xy, yy, trace at most 1.
    """

    vectors: Floats
    trust: Floats
    tensor: Floats


def grey_picture(color: Tensor, labels: Tensor | None) -> NDArray[np.uint8]:
    """(H, W) u8: brightness of a picture (H, W, 3), plus a constant per label of one-hot labels (H, W, L).

    Black outside. Without labels it is the brightness alone.
    """
    grey = color.cpu().numpy() @ _LUMA
    if labels is not None:
        count = labels.shape[2]
        levels = np.linspace(1.0 / count, 1.0, count, dtype=np.float32)
        grey = _TEXTURE * grey + (1 - _TEXTURE) * (labels.cpu().numpy() @ levels)
    return np.ascontiguousarray((np.clip(grey, 0.0, 1.0) * 255).astype(np.uint8))


def estimate_flow(source: NDArray[np.uint8], target: NDArray[np.uint8], fine: bool) -> Flow | None:
    """Flow from `source` to `target`, both (H, W); `fine` down to single pixels. None for tiny pictures."""
    height, width = source.shape
    if min(height, width) < _SMALLEST:
        return None
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(0 if fine else 1)
    method.setPatchStride(4 if fine else 3)
    forward = method.calc(source, target, np.zeros((height, width, 2), np.float32))
    backward = method.calc(target, source, np.zeros((height, width, 2), np.float32))
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    back = cv2.remap(backward, columns + forward[..., 0], rows + forward[..., 1], cv2.INTER_LINEAR)
    trust = np.exp(-np.square(forward + back).sum(axis=2) / _RETURN)
    trust = trust / (1.0 + np.square(forward).sum(axis=2) / _LARGE)
    across, down = (cv2.Sobel(source, cv2.CV_32F, *axis) / 8 for axis in ((1, 0), (0, 1)))
    products = (across * across, across * down, down * down)
    tensor = np.stack([cv2.GaussianBlur(part, (0, 0), _WINDOW) for part in products], axis=2)
    tensor = tensor / (tensor[..., :1] + tensor[..., 2:] + _NOISE)
    return Flow(
        forward.reshape(-1, 2).astype(np.float64),
        trust.reshape(-1).astype(np.float64),
        tensor.reshape(-1, 3).astype(np.float64),
    )


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of every texel's canonical displacement.

    Attributes:
        matrix: (N, 3, 3). right: (N, 3) px; the solution is in metres × `per_metre`.
    """

    matrix: Floats
    right: Floats

    @classmethod
    def zero(cls, count: int) -> NormalEquations:
        """Equations of `count` texels before any observation."""
        return cls(np.zeros((count, 3, 3)), np.zeros((count, 3)))

    def scale(self, factors: Floats) -> None:
        """Multiply the equations of every texel by a factor (N,)."""
        self.matrix[:] *= factors[:, None, None]
        self.right[:] *= factors[:, None]

    def add(
        self,
        means: Floats,
        jacobian: Floats,
        camera: Camera,
        depth: Floats,
        rendered: NDArray[np.bool_],
        pictured: NDArray[np.bool_],
        flow: Flow,
        per_metre: float,
    ) -> None:
        """Add the observations of one camera.

        Arguments:
            means: (N, 3) m, world. jacobian: (N, 3, 3) world from canonical directions.
            depth: (H, W) m of the render. rendered, pictured: (H, W) where render and picture show the layer.
        """
        height, width = depth.shape
        turn, focal = camera.camera_from_world[:3, :3], camera.intrinsics.diagonal()[:2]
        at = means @ turn.T + camera.camera_from_world[:3, 3]
        distance = np.maximum(at[:, 2], 1e-3)
        pixels = at[:, :2] / distance[:, None] * focal + camera.intrinsics[:2, 2]
        index, inside = _pixel_index(pixels, width, height)
        visible = inside & (at[:, 2] > 1e-3) & rendered.reshape(-1)[index]
        visible &= np.abs(depth.reshape(-1)[index] - distance) < _DEPTH_TOLERANCE
        chosen = np.nonzero(visible)[0]
        pixel = index[chosen]
        vectors = flow.vectors[pixel]
        goal, there = _pixel_index(pixels[chosen] + vectors, width, height)
        vectors = np.where(there[:, None], vectors, 0.0)  # out of the picture, or no number
        trust = flow.trust[pixel] * (there & pictured.reshape(-1)[goal])
        xx, xy, yy = (flow.tensor[pixel] * trust[:, None]).T
        metric = np.stack((xx, xy, xy, yy), axis=1).reshape(-1, 2, 2)
        z = distance[chosen]
        derivative = np.zeros((len(chosen), 2, 3))
        derivative[:, 0, 0], derivative[:, 1, 1] = focal[0] / z, focal[1] / z
        derivative[:, :, 2] = -focal * at[chosen, :2] / np.square(z)[:, None]
        derivative = derivative @ (turn @ jacobian[chosen]) / per_metre
        weighted = metric @ derivative
        self.matrix[chosen] += derivative.transpose(0, 2, 1) @ weighted
        self.right[chosen] += (vectors[:, None] @ weighted)[:, 0]


def collision_equations(
    means: Tensor, body: PosedGaussians, jacobian: Floats, per_metre: float
) -> tuple[Floats, Floats]:
    """Normal equations of one layer that push texels out to a clearance from the body, along its normal.

    Arguments:
        means: (N, 3) m, world. body: the body in the same pose. jacobian: (N, 3, 3) world from canonical
            directions. per_metre: unit of the solution, as in `NormalEquations`.

    Returns:
        Matrix (N, 3, 3) and right side (N, 3); zero for texels that are free.
    """
    points = means.double().cpu().numpy()
    positions, normals = (part.double().cpu().numpy() for part in (body.means, body.normals))
    distance, nearest = cKDTree(positions).query(points, k=_NEAREST, distance_upper_bound=_REACH)
    in_reach = np.isfinite(distance[:, -1])
    matrix, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    near = nearest[in_reach]
    normal = normals[near].mean(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(length, 1e-9)
    height = np.einsum("nk,nk->n", points[in_reach] - positions[near].mean(axis=1), normal)
    # Where normals of neighbours disagree, as between two fingers, there is no outward direction.
    wrong = (height < _CLEARANCE) & (length[:, 0] > 0.5)
    chosen = np.flatnonzero(in_reach)[wrong]
    along = np.einsum("nk,nkl->nl", normal[wrong], jacobian[chosen])
    matrix[chosen] = along[:, :, None] * along[:, None, :]
    right[chosen] = ((_CLEARANCE - height[wrong]) * per_metre)[:, None] * along
    return matrix, right


def _pixel_index(pixels: Floats, width: int, height: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Index into a flattened picture of every position (N, 2), 0 outside, and whether it is inside."""
    with np.errstate(invalid="ignore"):
        column, row = np.floor(np.clip(pixels, -2, 1e6)).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(inside, row * width + column, 0), inside
