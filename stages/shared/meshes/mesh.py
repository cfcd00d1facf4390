"""A triangle mesh with the attributes of a scan, and the checks of every mesh from a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.errors import BadData

MAX_VERTICES = 20_000_000
MAX_FACES = 40_000_000
Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) f32 metres.
        faces: (F, 3) i32 vertex indices, counter-clockwise seen from outside.
        colors: (V, 3) u8 sRGB, if any.
        labels: (V,) u8 label ids, if any.
    """

    vertices: Floats
    faces: Ints
    colors: NDArray[np.uint8] | None = None
    labels: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", np.ascontiguousarray(self.vertices, dtype=np.float32))
        object.__setattr__(self, "faces", np.ascontiguousarray(self.faces, dtype=np.int32))


class MeshArrays(NamedTuple):
    """The arrays of a `Mesh` as a file has them: vertices (V, 3) f64 in its own coordinates."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.integer]
    colors: NDArray[np.uint8] | None = None
    labels: NDArray[np.uint8] | None = None

    def mesh(self, origin: ArrayLike = 0.0) -> Mesh:
        """The mesh with `origin` (3,) of the file's coordinates at zero."""
        with np.errstate(over="ignore"):  # what is too large for 32 bits becomes infinite, and is refused
            vertices = (self.vertices - np.asarray(origin)).astype(np.float32)
        return Mesh(vertices, self.faces.astype(np.int32), self.colors, self.labels)


def check_mesh(mesh: Mesh, where: str) -> Mesh:
    """The mesh, if it can be worked with.

    Raises:
        BadData: no vertices or faces, NaN, faces that name vertices which are not there, too large.
    """
    if len(mesh.vertices) == 0:
        raise BadData("The mesh has no vertices.", where, "Export the mesh again.")
    if len(mesh.faces) == 0:
        raise BadData(
            "The mesh has no faces: it is a cloud of points.",
            where,
            "Export it with faces, or reconstruct a surface.",
        )
    if len(mesh.vertices) > MAX_VERTICES or len(mesh.faces) > MAX_FACES:
        raise BadData(
            f"The mesh has {len(mesh.vertices)} vertices and {len(mesh.faces)} faces, more than can be read "
            f"({MAX_VERTICES} and {MAX_FACES}).",
            where,
            "Simplify the mesh.",
        )
    broken = ~np.isfinite(mesh.vertices).all(axis=1)
    if broken.any():
        raise BadData(
            f"{int(broken.sum())} vertices are NaN or infinite, the first is {int(np.argmax(broken))}.",
            where,
            "Remove them, or export the mesh again.",
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        face = int(np.argmax(((mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))).any(axis=1)))
        raise BadData(
            f"Face {face} names a vertex that is not there; the mesh has {len(mesh.vertices)}.",
            where,
            "Export the mesh again.",
        )
    return mesh
