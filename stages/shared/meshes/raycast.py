"""Rays against a mesh (Embree through Open3D): first hits, renders, orthographic maps, distances.

Open3D works in single precision; the results here are good to about 1e-5 of the size of the scene.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.errors import MissingInput

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
NO_HIT = -1
# Libraries of the system that open3d's wheel links against, and Debian's packages of them.
SYSTEM_LIBRARIES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
}


@functools.cache
def load_open3d() -> ModuleType:
    """The module `open3d`, imported on first use; nothing else imports it.

    Its Linux wheel links against libusb (for depth cameras, which are not used here) and fails to import
    where the system has none. The wheel `libusb-package` brings that library; it is loaded first under the
    same soname. No wheel brings the libraries for windows (`SYSTEM_LIBRARIES`): every desktop has them, a
    small server or container image may not.

    Raises:
        MissingInput: a library of the system that it links against is not there; names the packages.
    """
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError, TypeError):
        pass  # a system libusb serves as well; where there is neither, open3d's own error names it
    try:
        import open3d
    except ModuleNotFoundError:
        raise
    except ImportError as error:
        raise MissingInput(
            f"open3d cannot be loaded: {error}.",
            "the wheel open3d",
            "Install the libraries that it links against: apt install "
            + " ".join(SYSTEM_LIBRARIES.values())
            + " (Debian, Ubuntu).",
        ) from error
    return open3d


class RayCamera(Protocol):
    """Anything with an origin (3,) and directions (H, W, 3) of the rays through its pixel centres, world."""

    def rays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...


@dataclass(frozen=True, eq=False)
class Hits:
    """What a set of rays of any shape (...) met first.

    Attributes:
        distance: (...) f32 in lengths of the ray direction; infinity where nothing was met.
        face: (...) i32, -1 where nothing was met.
        barycentric: (..., 3) f32 weights of the three corners of the face.
    """

    distance: Floats
    face: Ints
    barycentric: Floats

    @property
    def hit(self) -> NDArray[np.bool_]:
        """(...) whether anything was met."""
        return self.face >= 0

    def interpolate(self, faces: NDArray, values: ArrayLike, outside: float = 0.0) -> Floats:
        """Per-vertex values (V, C) at the hits: (..., C) f32, `outside` where nothing was met."""
        values = np.asarray(values, dtype=np.float32)
        result = np.full((*self.face.shape, values.shape[1]), outside, np.float32)
        hit = self.hit
        corners = values[np.asarray(faces)[self.face[hit]]]  # (n, 3, C)
        result[hit] = np.einsum("nk,nkc->nc", self.barycentric[hit], corners)
        return result

    def largest_corner(self, faces: NDArray, values: NDArray, outside: int) -> NDArray:
        """Per-vertex values (V,) of the nearest corner at the hits (for labels, which cannot be averaged)."""
        result = np.full(self.face.shape, outside, values.dtype)
        hit = self.hit
        corner = self.barycentric[hit].argmax(axis=-1)
        result[hit] = values[np.asarray(faces)[self.face[hit], corner]]
        return result


class RayScene:
    """One mesh, ready for rays."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        """A scene of one mesh: vertices (V, 3), faces (F, 3)."""
        self._open3d = load_open3d()
        core = self._open3d.core
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float32)
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        self._scene = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(core.Tensor(self.vertices), core.Tensor(self.faces.astype(np.uint32)))

    @classmethod
    def of_parts(cls, parts: Sequence[tuple[NDArray, NDArray]]) -> RayScene:
        """The scene of several meshes, each given by vertices (V, 3) and faces (F, 3)."""
        starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
        faces = [faces + start for (_, faces), start in zip(parts, starts, strict=True)]
        return cls(np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces))

    def first_hits(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """First hits of rays with origins (..., 3) and directions (..., 3), which need no unit length."""
        origins = np.asarray(origins, dtype=np.float32)
        directions = np.asarray(directions, dtype=np.float32)
        origins, directions = np.broadcast_arrays(origins, directions)
        rays = np.concatenate([origins, directions], axis=-1)
        answer = self._scene.cast_rays(self._open3d.core.Tensor(np.ascontiguousarray(rays)))
        distance = answer["t_hit"].numpy()
        face = answer["primitive_ids"].numpy().astype(np.int64)
        hit = np.isfinite(distance)
        uv = answer["primitive_uvs"].numpy()
        barycentric = np.concatenate([1 - uv.sum(axis=-1, keepdims=True), uv], axis=-1).astype(np.float32)
        barycentric[~hit] = 0
        return Hits(distance, np.where(hit, face, NO_HIT).astype(np.int32), barycentric)

    def render(self, camera: RayCamera) -> Hits:
        """The mesh through a camera: hits (H, W) of rays through pixel centres; distance is depth."""
        origin, directions = camera.rays()
        return self.first_hits(origin, directions)

    def occluded(self, origins: ArrayLike, targets: ArrayLike, tolerance: float) -> NDArray[np.bool_]:
        """Which targets (N, 3) are hidden from origins (N, 3) or (3,) by the mesh.

        Something nearer to the target than `tolerance` metres does not hide it, so points on the mesh see.
        """
        targets = np.asarray(targets, dtype=np.float64)
        towards = targets - np.asarray(origins, dtype=np.float64)
        length = np.linalg.norm(towards, axis=-1)
        directions = towards / np.maximum(length, 1e-12)[..., None]
        return self.first_hits(origins, directions).distance < length - tolerance

    def closest(self, points: ArrayLike) -> tuple[Floats, Ints, Floats]:
        """Closest point (N, 3), its face (N,) and barycentric weights (N, 3), for points (N, 3)."""
        query = self._open3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
        answer = self._scene.compute_closest_points(query)
        uv = answer["primitive_uvs"].numpy()
        barycentric = np.concatenate([1 - uv.sum(axis=-1, keepdims=True), uv], axis=-1).astype(np.float32)
        return answer["points"].numpy(), answer["primitive_ids"].numpy().astype(np.int32), barycentric

    def distance(self, points: ArrayLike) -> Floats:
        """(N,) distance to the mesh, metres."""
        query = self._open3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
        return np.asarray(self._scene.compute_distance(query).numpy())

    def signed_distance(self, points: ArrayLike, samples: int = 5) -> Floats:
        """(N,) distance to a closed mesh, metres, negative inside (majority of `samples` rays)."""
        query = self._open3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
        return np.asarray(self._scene.compute_signed_distance(query, nsamples=samples).numpy())

    def orthographic(self, x: ArrayLike, y: ArrayLike, back: bool = False) -> Hits:
        """First hits (H, W) of a parallel view along z, from +z (front) or -z (back).

        Rays run through columns x (W,) and rows y (H,); the back view keeps the columns of the front view (it
        is not mirrored). Distance counts from a plane 1 m before the mesh.
        """
        columns, rows = np.meshgrid(np.asarray(x, np.float32), np.asarray(y, np.float32))
        sign = -1.0 if back else 1.0
        start = (self.vertices[:, 2] * sign).max() + 1.0 if len(self.vertices) else 1.0
        origins = np.stack([columns, rows, np.full_like(columns, sign * start)], axis=-1)
        direction = np.array([0.0, 0.0, -sign], np.float32)
        return self.first_hits(origins, direction)
