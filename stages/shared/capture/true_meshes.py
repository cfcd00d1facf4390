"""True garment meshes of a take, as simulated captures carry them: for judging, never for learning.

File (`.npz`; `gw synth` writes `takes/<take>/gt/meshes.npz`): `frames` (T,) int, the frame numbers that it
holds; per garment `<layer>_v` (T, V, 3) metres world and `<layer>_f` (F, 3) triangles. Vertices keep their
number from frame to frame, and between takes of one garment: that is what makes points of the cloth known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.body.npz import NumericNpz
from stages.shared.capture.take import Capture
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.layers import SLOTS

_WHAT = "true meshes"
_PLACES = ("{take}/gt/meshes.npz", "takes/{take}/gt/meshes.npz")
_FIX = "Give frames (T,), <layer>_v (T, V, 3) and <layer>_f (F, 3); see docs/formats.md."


@dataclass(frozen=True, eq=False)
class TrueMesh:
    """A garment in every frame: vertices (T, V, 3) f32 m world, faces (F, 3) i32."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]

    def same_cloth(self, other: TrueMesh) -> bool:
        """Whether vertices of the same number are the same points of the cloth."""
        counts = self.vertices.shape[1] == other.vertices.shape[1]
        return counts and bool(np.array_equal(self.faces, other.faces))


@dataclass(frozen=True, eq=False)
class TrueMeshes:
    """What is known of a take: `rows` frame number to row of the meshes, `layers` garment to mesh."""

    rows: Mapping[int, int]
    layers: Mapping[str, TrueMesh]

    def at(self, layer: str, frame: int) -> NDArray[np.float32]:
        """(V, 3) m, world. Raises KeyError for a frame or layer that is not known."""
        return self.layers[layer].vertices[self.rows[frame]]


def read_true_meshes(path: Path) -> TrueMeshes:
    """Read one file.

    Raises:
        MissingInput: no such file. BadData: damaged, no garment in it, or arrays that do not fit together.
    """
    with NumericNpz(path, _WHAT) as archive:
        frames = _integers(archive.array("frames"), path, "frames")
        if frames.ndim != 1 or len(np.unique(frames)) != len(frames) or (frames < 0).any():
            raise BadData("frames is no list of different frame numbers.", f"{path}: frames", _FIX)
        names = [layer for layer in SLOTS if f"{layer}_v" in archive]
        if not names:
            raise BadData("There is no garment among the true meshes.", str(path), _FIX)
        layers = {name: _mesh(archive, name, len(frames)) for name in names}
    return TrueMeshes({int(frame): row for row, frame in enumerate(frames)}, layers)


def true_meshes_of(given: list[str], capture: Capture) -> dict[str, TrueMeshes]:
    """Take to true meshes, for what is given on a command line.

    Each entry is `TAKE=FILE`, a FILE in a folder called like its take, or the folder of a capture whose takes
    have theirs in `gt/meshes.npz`.

    Raises:
        UsageProblem: it is not clear of which take a file is. MissingInput, BadData: as `read_true_meshes`.
    """
    takes = [take.name for take in capture.takes]
    files: dict[str, Path] = {}
    for entry in given:
        name, _, rest = entry.partition("=")
        if rest and name in takes:
            files[name] = Path(rest)
        elif Path(entry).is_dir():
            files |= _found_in(Path(entry), takes)
        else:
            files[_take_of(Path(entry), takes)] = Path(entry)
    return {take: read_true_meshes(path) for take, path in files.items()}


def _found_in(folder: Path, takes: list[str]) -> dict[str, Path]:
    places = {take: [folder / place.format(take=take) for place in _PLACES] for take in takes}
    found = {take: next((p for p in paths if p.is_file()), None) for take, paths in places.items()}
    known = {take: path for take, path in found.items() if path is not None}
    if not known:
        raise MissingInput(
            "No take has true meshes there.", str(folder), "Give the files: --true-meshes TAKE=FILE."
        )
    return known


def _take_of(path: Path, takes: list[str]) -> str:
    """The take whose name is the last of the folders above the file that is called like a take."""
    if not path.is_file():
        raise MissingInput(f"There is no file for {_WHAT}.", str(path), "Check the path.")
    named = [part for part in reversed(path.absolute().parts) if part in takes]
    if not named and len(takes) > 1:
        raise UsageProblem(
            "It is not clear of which take these true meshes are.",
            str(path),
            f"Say it: --true-meshes TAKE={path}, with TAKE one of: {', '.join(takes)}.",
        )
    return named[0] if named else takes[0]


def _mesh(archive: NumericNpz, layer: str, frames: int) -> TrueMesh:
    vertices, faces = archive.array(f"{layer}_v"), archive.array(f"{layer}_f")
    faces = _integers(faces, archive.path, f"{layer}_f")
    shaped = vertices.ndim == 3 and vertices.shape[0] == frames and vertices.shape[2] == 3
    if not shaped or vertices.dtype.kind != "f" or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise BadData(
            f"{layer}_v has shape {vertices.shape} and {layer}_f {faces.shape} for {frames} frames.",
            str(archive.path),
            _FIX,
        )
    if faces.min() < 0 or faces.max() >= vertices.shape[1]:
        raise BadData(f"{layer}_f names vertices that do not exist.", str(archive.path), _FIX)
    return TrueMesh(vertices.astype(np.float32), faces.astype(np.int32))


def _integers(values: NDArray, path: Path, name: str) -> NDArray:
    if values.dtype.kind not in "iu":
        raise BadData(f"{name} does not hold integers.", f"{path}: {name}", _FIX)
    return values
