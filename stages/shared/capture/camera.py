"""One calibrated camera: pinhole, no distortion, OpenCV axes, pixel centres at integer + 0.5."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.finite import require_finite

if TYPE_CHECKING:
    import torch

Matrix = NDArray[np.float64]
Box = tuple[int, int, int, int]  # left, top, right, bottom in pixels; right and bottom are outside

MAX_SIDE = 65_536


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Attributes:
        name: as the capture calls it.
        width, height: pixels.
        intrinsics: (3, 3) f64, pixels; a principal point of (W/2, H/2) is the centre of the image.
        camera_from_world: (4, 4) f64, metres; x right, y down, z forward.
    """

    name: str
    width: int
    height: int
    intrinsics: Matrix
    camera_from_world: Matrix

    def __post_init__(self) -> None:
        intrinsics = np.array(self.intrinsics, dtype=np.float64)
        camera_from_world = np.eye(4)
        given = np.asarray(self.camera_from_world, dtype=np.float64)
        if intrinsics.shape != (3, 3) or given.shape not in ((3, 4), (4, 4)):
            raise ValueError(f"camera {self.name}: matrices of shape {intrinsics.shape} and {given.shape}")
        camera_from_world[: given.shape[0]] = given
        object.__setattr__(self, "intrinsics", intrinsics)
        object.__setattr__(self, "camera_from_world", camera_from_world)

    def tensors(self, device: torch.device | str = "cpu") -> tuple[torch.Tensor, torch.Tensor]:
        """camera_from_world (4, 4) and intrinsics (3, 3), float64, as `rasterize` takes them."""
        import torch

        return tuple(torch.from_numpy(m).to(device) for m in (self.camera_from_world, self.intrinsics))  # type: ignore[return-value]

    @property
    def world_from_camera(self) -> Matrix:
        """(4, 4) f64, the inverse rigid transform."""
        rotation, translation = self.camera_from_world[:3, :3], self.camera_from_world[:3, 3]
        inverse = np.eye(4)
        inverse[:3, :3] = rotation.T
        inverse[:3, 3] = -rotation.T @ translation
        return inverse

    @property
    def centre(self) -> Matrix:
        """(3,) f64, where the camera stands, world, metres."""
        return self.world_from_camera[:3, 3]

    def project(self, points: ArrayLike) -> tuple[Matrix, Matrix]:
        """Pixels (..., 2) f64 (x, y) and depths (...,) f64 along the optical axis of world points (..., 3).

        Points at depth 0 or less get NaN pixels; points that are not finite are refused (BadData).
        """
        points = np.asarray(points, dtype=np.float64)
        require_finite("Camera.project", points=points)
        in_camera = points @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        depth = in_camera[..., 2]
        homogeneous = in_camera @ self.intrinsics.T
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = homogeneous[..., :2] / depth[..., None]
        return np.where(depth[..., None] > 0, pixels, np.nan), depth

    def rays(self) -> tuple[Matrix, Matrix]:
        """Origin (3,) and directions (H, W, 3) through the pixel centres, world; 1 m of depth per length."""
        columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        pixels = np.stack([columns, rows, np.ones_like(columns)], axis=-1)
        in_camera = pixels @ np.linalg.inv(self.intrinsics).T
        return self.centre, in_camera @ self.camera_from_world[:3, :3]

    def crop(self, box: Box) -> Camera:
        """The camera of the part of the image inside `box` (left, top, right, bottom)."""
        left, top, right, bottom = box
        if right <= left or bottom <= top:
            raise ValueError(f"empty box {box}")
        intrinsics = self.intrinsics.copy()
        intrinsics[:2] -= np.array([[left], [top]]) * intrinsics[2]
        return replace(self, width=right - left, height=bottom - top, intrinsics=intrinsics)

    def scaled(self, factor: float) -> Camera:
        """The camera of the image resized by `factor`; sides are rounded to whole pixels."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        intrinsics = self.intrinsics.copy()
        intrinsics[0] *= width / self.width
        intrinsics[1] *= height / self.height
        return replace(self, width=width, height=height, intrinsics=intrinsics)

    def in_view(self, pixels: Matrix) -> NDArray[np.bool_]:
        """Which pixels (..., 2) lie on the image; NaN does not."""
        with np.errstate(invalid="ignore"):
            return (
                (pixels[..., 0] >= 0)
                & (pixels[..., 0] < self.width)
                & (pixels[..., 1] >= 0)
                & (pixels[..., 1] < self.height)
            )


def rotation_error(matrix: Matrix) -> tuple[float, float]:
    """How far (3, 3) is from a rotation: the largest entry of |R Rᵀ − 1|, and its determinant."""
    return float(np.abs(matrix @ matrix.T - np.eye(3)).max()), float(np.linalg.det(matrix))
