"""What a simulation mesh in a file may hold: the tensors `cloth/…` and the manifest's entry `cloth`.

V vertices, F faces, E edges, N texels:
    vertices (V,3) f32 m canonical, zero shape · rest_vertices (V,3) f32 m, template's pose, world
    faces (F,3) i32 · pinned (V,) i32 0 or 1 · rest_lengths (E,) f32 m of the sorted edges
    skin_margin (V,) f32 m · skin_weights (V,55) f32 · shape_directions (V,10,3) f32 m per unit of shape
    pose (55,3) f32 axis-angle of the template
    texel_faces (N,) i32 · texel_weights (N,3) f32 barycentric · texel_offsets (N,3) f32 m
Entry: {"material": values by name, "drive": "bones", "learned" or "simulated"}.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData

DRIVERS = ("bones", "learned", "simulated")
MAX_VERTICES = 20_000
MAX_FACES = 4 * MAX_VERTICES
JOINTS, BETAS = 55, 10
BOX = 3.0  # metres
LARGEST_MARGIN = 0.2  # metres
LARGEST_OFFSET = 0.5  # metres between a texel and the mesh

MATERIAL_RANGES: dict[str, tuple[float, float]] = {
    "density": (1e-3, 10.0),
    "edge_stiffness": (1.0, 1e9),
    "bending": (0.0, 1.0),
    "bending_damping": (0.0, 10.0),
    "drag": (0.0, 1e3),
    "skin_friction": (0.0, 10.0),
    "cloth_friction": (0.0, 10.0),
    "repulsion": (0.0, 0.1),
    "rest_curvature": (-2.0, 2.0),
    "steps_per_second": (1.0, 20_000.0),
}
_BY_VERTEX: dict[str, tuple[int, ...]] = {
    "vertices": (3,),
    "rest_vertices": (3,),
    "pinned": (),
    "skin_margin": (),
    "skin_weights": (JOINTS,),
    "shape_directions": (BETAS, 3),
}
_BY_TEXEL: dict[str, tuple[int, ...]] = {"texel_faces": (), "texel_weights": (3,), "texel_offsets": (3,)}
INTEGERS = ("faces", "pinned", "texel_faces")
CLOTH_ARRAYS = ("faces", *_BY_VERTEX, *_BY_TEXEL, "rest_lengths", "pose")

Shapes = Mapping[str, tuple[str, tuple[int, ...]]]


def check_cloth_entry(entry: Any, where: str) -> None:
    """Raise BadData unless a manifest's entry says a possible material and driver."""
    if not isinstance(entry, dict) or set(entry) != {"material", "drive"}:
        raise _bad("what it says about its simulation is not understood", where)
    if entry["drive"] not in DRIVERS:
        raise _bad(f"its driver is {str(entry['drive'])[:40]!r}", where)
    check_material(entry["material"], where)


def check_material(values: Any, where: str) -> None:
    """Raise BadData unless all values of a cloth material are there and possible."""
    names = {*MATERIAL_RANGES, "balanced"}
    if not isinstance(values, dict) or set(values) != names:
        raise _bad(f"a cloth material has the values {', '.join(sorted(names))}", where)
    for name, (least, most) in MATERIAL_RANGES.items():
        value = values[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
            raise _bad(f"{name} is {str(value)[:40]}; it lies between {least:g} and {most:g}", where)
    if not isinstance(values["balanced"], bool):
        raise _bad("balanced is neither true nor false", where)


def check_cloth_layout(layout: Shapes, texels: int, where: str) -> None:
    """Raise BadData unless types (F32, I32) and shapes fit each other and the number of texels."""
    for name in CLOTH_ARRAYS:
        if name not in layout or not layout[name][1]:
            raise _bad("a tensor is missing", where, name)
    extra = sorted(set(layout) - set(CLOTH_ARRAYS))
    if extra:
        raise _bad("a tensor has a name that means nothing", where, extra[0])
    vertices, faces, lengths = (layout[name][1][0] for name in ("vertices", "faces", "rest_lengths"))
    if not 3 <= vertices <= MAX_VERTICES or not 1 <= faces <= MAX_FACES:
        raise _bad(f"it has {vertices} vertices and {faces} faces, which cannot be simulated", where, "faces")
    expected = {name: (vertices, *shape) for name, shape in _BY_VERTEX.items()}
    expected |= {name: (texels, *shape) for name, shape in _BY_TEXEL.items()}
    expected |= {"faces": (faces, 3), "rest_lengths": (lengths,), "pose": (JOINTS, 3)}
    for name, shape in expected.items():
        kind = "I32" if name in INTEGERS else "F32"
        if layout[name] != (kind, shape):
            raise _bad(f"it is {layout[name][0]} {layout[name][1]}, not {kind} {shape}", where, name)


def check_cloth_values(arrays: Mapping[str, NDArray[Any]], where: str) -> None:
    """Raise BadData unless the values are finite and possible; types and shapes have been checked."""
    faces = arrays["faces"]
    if faces.min() < 0 or faces.max() >= len(arrays["vertices"]):
        raise _bad("a face names a vertex that does not exist", where, "faces")
    corners = np.sort(faces, axis=1)
    if (np.diff(corners, axis=1) == 0).any():
        raise _bad("a face has a vertex twice", where, "faces")
    edges = np.unique(corners[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=0)
    if len(arrays["rest_lengths"]) != len(edges):
        what = f"there are {len(arrays['rest_lengths'])} rest lengths for {len(edges)} edges"
        raise _bad(what, where, "rest_lengths")
    bounds = {
        "vertices": (-BOX, BOX),
        "skin_margin": (-LARGEST_MARGIN, LARGEST_MARGIN),
        "skin_weights": (-1e-6, 1.001),
        "shape_directions": (-1.0, 1.0),
        "rest_lengths": (1e-5, BOX),
        "pose": (-10.0, 10.0),
        "pinned": (0, 1),
        "texel_faces": (0, len(faces) - 1),
        "texel_weights": (-0.01, 1.01),
        "texel_offsets": (-LARGEST_OFFSET, LARGEST_OFFSET),
    }
    for name in CLOTH_ARRAYS:
        if name not in INTEGERS and not np.isfinite(arrays[name]).all():
            raise _bad("a tensor holds NaN or infinity", where, name)
    for name, (least, most) in bounds.items():
        if arrays[name].min() < least or arrays[name].max() > most:
            raise _bad(f"a value is not between {least:g} and {most:g}", where, name)
    rest = arrays["rest_vertices"].astype(np.float64)
    if np.abs(rest).max() > 1e4 or np.abs(rest - rest.mean(axis=0)).max() > BOX:
        raise _bad(f"a vertex is farther than {BOX:g} m from the others", where, "rest_vertices")
    sides = rest[faces]
    normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    if np.linalg.norm(normals, axis=1).min() < 2e-9:
        raise _bad("a face has no area", where, "rest_vertices")
    for name in ("skin_weights", "texel_weights"):
        if np.abs(arrays[name].sum(axis=1, dtype=np.float64) - 1).max() > 1e-2:
            raise _bad("a row does not sum to one", where, name)


def _bad(what: str, where: str, tensor: str | None = None) -> BadData:
    return BadData(
        f"The simulation mesh cannot be used: {what}.",
        where if tensor is None else f"{where}, tensor 'cloth/{tensor}'",
        "Fetch a whole copy, or fit the cloth and export the garment again.",
    )
