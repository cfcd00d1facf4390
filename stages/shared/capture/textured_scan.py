"""Scans with their texture, and what virtual cameras see of them.

4D-DRESS publishes four cameras only; its scans carry the light of the studio in an atlas (v up), so pictures
of them from anywhere show what a camera there would have seen, less highlights that move with the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera
from stages.shared.capture.pickled_scan import read_scan
from stages.shared.capture.pickles import PickleReader
from stages.shared.capture.projection import sample_bilinear
from stages.shared.errors import BadData
from stages.shared.layers import NO_LABEL
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene

_GREY = 150
_Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class TexturedScan:
    """A mesh with texture coordinates (V, 2), v up, and an atlas (H, W, 3) u8 sRGB; both None without."""

    mesh: Mesh
    uvs: NDArray[np.float32] | None = None
    atlas: _Image | None = None


def read_textured_scan(path: Path) -> TexturedScan:
    """The scan `Meshes_pkl/mesh-f*.pkl` with `atlas-f*.pkl` beside it, where there is one.

    Raises:
        MissingInput, BadData: as `read_scan`; an atlas or coordinates of another shape.
    """
    mesh = read_scan(path)
    atlas_path = path.with_name(path.name.replace("mesh-", "atlas-"))
    if not atlas_path.is_file():
        return TexturedScan(mesh)
    with PickleReader() as pickles:
        uvs, atlas = pickles.read(path).get("uvs"), pickles.read(atlas_path)
    if not isinstance(uvs, np.ndarray):
        return TexturedScan(mesh)
    if uvs.shape != (len(mesh.vertices), 2) or not isinstance(atlas, np.ndarray) or atlas.ndim != 3:
        raise BadData(
            "The atlas or its coordinates do not fit the mesh.", str(atlas_path), "Get the file again."
        )
    return TexturedScan(mesh, uvs.astype(np.float32), atlas[..., :3].astype(np.uint8))


def render_scan(scan: TexturedScan, camera: Camera) -> tuple[_Image, _Image, _Image | None]:
    """Image (H, W, 3) u8 sRGB on black, mask (H, W) u8 0 or 255, and label ids (H, W) u8 or None."""
    mesh = scan.mesh
    hits = RayScene(mesh.vertices, mesh.faces).render(camera)
    if scan.uvs is not None and scan.atlas is not None:
        uvs = hits.interpolate(mesh.faces, scan.uvs)[hits.hit].astype(np.float64)
        height, width = scan.atlas.shape[:2]
        # v counts from the lower edge of the atlas, rows from the upper one.
        pixels = np.stack([uvs[:, 0] * width, (1 - uvs[:, 1]) * height], axis=1)
        image = np.zeros((*hits.face.shape, 3), np.uint8)
        image[hits.hit] = np.rint(sample_bilinear(scan.atlas, pixels)).astype(np.uint8)
    elif mesh.colors is not None:
        image = np.rint(hits.interpolate(mesh.faces, mesh.colors)).astype(np.uint8)
    else:
        image = np.where(hits.hit[..., None], np.uint8(_GREY), np.uint8(0)).repeat(3, axis=-1)
    labels = None
    if mesh.labels is not None:
        labels = hits.largest_corner(mesh.faces, mesh.labels, NO_LABEL).astype(np.uint8)
    return image, np.where(hits.hit, 255, 0).astype(np.uint8), labels


def ring_of_cameras(
    low: NDArray[np.floating], high: NDArray[np.floating], count: int, width: int, height: int
) -> list[Camera]:
    """Cameras evenly around a box (low, high: (3,) metres, y up) that see all of it, at chest height.

    Every second one stands higher and looks down a little, so that shoulders and floor-facing parts are seen.
    """
    middle = (np.asarray(low, np.float64) + high) / 2
    reach = np.asarray(high, np.float64) - low
    focal = 1.25 * height
    radius = float(np.hypot(reach[0], reach[2])) / 2
    # The half diagonal of the box fits into half of the smaller field of view, with a margin.
    distance = 1.15 * max(reach[1] / 2 * focal / (height / 2), (radius + 0.1) * focal / (width / 2)) + radius
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cameras = []
    for number in range(count):
        angle = 2 * np.pi * number / count
        lift = np.radians(18.0 if number % 2 else 2.0)
        back = np.array([np.sin(angle) * np.cos(lift), np.sin(lift), np.cos(angle) * np.cos(lift)])
        right = np.array([np.cos(angle), 0.0, -np.sin(angle)])
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = np.stack([right, -np.cross(back, right), -back])
        camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ (middle + distance * back)
        cameras.append(Camera(f"virtual{number:02d}", width, height, intrinsics, camera_from_world))
    return cameras
