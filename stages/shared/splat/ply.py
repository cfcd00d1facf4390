"""Gaussians as a .ply file in the layout of 3D Gaussian splatting, which viewers and editors read.

One element `vertex`, binary little-endian, float32 properties x y z, nx ny nz (unused, 0), f_dc_0..2,
f_rest_0.. (view dependence, channel by channel; may be absent), opacity, scale_0..2, rot_0..3. Colours are
the constant term of spherical harmonics, opacities logits, scales logarithms of metres, rotations w x y z.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts import write_whole
from stages.shared.errors import BadData, MissingInput

Floats = NDArray[np.float32]

HARMONIC = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi))."""

_OPACITY_MARGIN, _SMALLEST_SCALE = 1e-6, 1e-6
_LONGEST_HEADER = 1 << 16
_TYPES = {
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1",
    "char": "i1", "int8": "i1", "ushort": "<u2", "uint16": "<u2", "short": "<i2", "int16": "<i2",
    "uint": "<u4", "uint32": "<u4", "int": "<i4", "int32": "<i4",
}  # fmt: skip


@dataclass(frozen=True)
class SplatCloud:
    """N Gaussians as `rasterize` takes them.

    means (N, 3) m; quats (N, 4) wxyz, unit; scales (N, 3) m; opacities (N,) in [0, 1]; colors (N, 3) sRGB in
    0..1; harmonics (N, K, 3) or None: view-dependent coefficients beyond the constant; layers (N,) uint8 or
    None.
    """

    means: Floats
    quats: Floats
    scales: Floats
    opacities: Floats
    colors: Floats
    harmonics: Floats | None = None
    layers: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.means)


def write_splat_ply(path: Path, cloud: SplatCloud, with_layers: bool = False) -> None:
    """Write the file whole or not at all.

    Opacities are brought into [1e-6, 1 - 1e-6], scales to at least 1e-6 m, colours into [0, 1]: what the
    layout can hold. `with_layers` adds a property `layer` (uchar), which some viewers refuse.

    Raises BadData for arrays that do not fit together or are not finite.
    """
    n = len(cloud)
    extra = 0 if cloud.harmonics is None else cloud.harmonics.shape[1]
    shapes = {
        "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "colors": (n, 3),
        "harmonics": (n, extra, 3), "layers": (n,),
    }  # fmt: skip
    for field in fields(cloud):
        array = getattr(cloud, field.name)
        if array is None:
            continue
        if array.shape != shapes[field.name]:
            raise _refused(f"{field.name} has shape {array.shape}; {shapes[field.name]} is needed", path)
        if not np.isfinite(array).all():
            raise _refused(f"{field.name} has a value that is not finite", path)
    opacity = np.clip(cloud.opacities.astype(np.float64), _OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    columns: list[tuple[str, NDArray[np.generic]]] = [
        *zip("xyz", cloud.means.T, strict=True),
        *((name, np.zeros(n)) for name in ("nx", "ny", "nz")),
        *((f"f_dc_{i}", (np.clip(cloud.colors[:, i], 0, 1) - 0.5) / HARMONIC) for i in range(3)),
    ]
    if cloud.harmonics is not None:
        flat = cloud.harmonics.transpose(0, 2, 1).reshape(n, 3 * extra)
        columns += [(f"f_rest_{i}", flat[:, i]) for i in range(3 * extra)]
    columns.append(("opacity", np.log(opacity / (1 - opacity))))
    columns += [(f"scale_{i}", np.log(np.maximum(cloud.scales[:, i], _SMALLEST_SCALE))) for i in range(3)]
    columns += [(f"rot_{i}", cloud.quats[:, i]) for i in range(4)]
    kinds = [(name, "<f4") for name, _ in columns]
    if with_layers and cloud.layers is not None:
        columns.append(("layer", cloud.layers))
        kinds.append(("layer", "u1"))
    table = np.zeros(n, np.dtype(kinds))
    for name, values in columns:
        table[name] = values
    words = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property {words[kind]} {name}" for name, kind in kinds]
    write_whole(path, ("\n".join([*header, "end_header"]) + "\n").encode() + table.tobytes())


def read_splat_ply(path: Path) -> SplatCloud:
    """Read a file of this layout; properties may come in any order, unknown ones are skipped.

    Needed are x y z, opacity and scale_0..2. Without rot_* Gaussians are not turned, without f_dc_* grey.

    Raises MissingInput (no such file), BadData (another layout, truncated, numbers that cannot be meant).
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise MissingInput("There is no such file.", str(path), "Check the path.") from None
    table = _table(data, path)
    names = set(table.dtype.names or ())
    missing = [
        name for name in ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2") if name not in names
    ]
    if missing:
        raise _refused("it has no property " + ", ".join(missing), path)

    def columns(prefix: str, count: int) -> NDArray[np.float64] | None:
        properties = [f"{prefix}{i}" for i in range(count)]
        if not names.issuperset(properties):
            return None
        return np.stack([table[name].astype(np.float64) for name in properties], 1)

    n = len(table)
    means = np.stack([table[name].astype(np.float64) for name in "xyz"], 1)
    logs, quats, constant = columns("scale_", 3), columns("rot_", 4), columns("f_dc_", 3)
    logit = table["opacity"].astype(np.float64)
    rest = sum(1 for name in names if name.startswith("f_rest_"))
    flat = columns("f_rest_", rest) if rest and rest % 3 == 0 else None
    for name, array in (
        ("x y z", means),
        ("scale", logs),
        ("opacity", logit),
        ("rot", quats),
        ("f_dc", constant),
    ):
        if array is not None and not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise _refused(f"{name} of vertex {row} is not a finite number", path)
    assert logs is not None
    if n and logs.max() > 80:
        raise _refused(f"scale of vertex {int(logs.max(1).argmax())} is above e^80 m", path)
    if quats is None:
        quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    if n and length.min() == 0:
        raise _refused(f"rot of vertex {int(length.argmin())} is zero", path)
    colors = np.full((n, 3), 0.5) if constant is None else np.clip(0.5 + HARMONIC * constant, 0, 1)
    with np.errstate(over="ignore"):  # exp(-logit) of a very transparent Gaussian is infinite, its inverse 0
        opacities = 1 / (1 + np.exp(-logit))
    single = (x.astype(np.float32) for x in (means, quats / length, np.exp(logs), opacities, colors))
    means32, quats32, scales32, opacities32, colors32 = single
    harmonics = None if flat is None else flat.reshape(n, 3, rest // 3).transpose(0, 2, 1).astype(np.float32)
    layers = table["layer"].astype(np.uint8) if "layer" in names else None
    return SplatCloud(means32, quats32, scales32, opacities32, colors32, harmonics, layers)


def _table(data: bytes, path: Path) -> NDArray[np.void]:
    """The vertex element as a structured array."""
    end = data.find(b"end_header", 0, _LONGEST_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise _refused("it is not a PLY file", path)
    start = data.index(b"\n", end) + 1 if b"\n" in data[end : end + 12] else len(data)
    kinds: list[tuple[str, str]] = []
    count, element = -1, ""
    for line in data[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words[0] == "format" and words[1:2] != ["binary_little_endian"]:
            raise _refused(f"its format is {' '.join(words[1:])}, not binary_little_endian", path)
        if words[0] == "element" and len(words) == 3 and words[2].isdigit():
            if element:
                break  # what follows the vertices is not read
            element, count = words[1], int(words[2])
            if element == "chunk" and b"packed_position" in data[:end]:
                raise BadData(
                    "This is a compressed PLY of PlayCanvas and SuperSplat, which is not read.",
                    os.fspath(path),
                    "Save it uncompressed there, or run: splat-transform FILE.compressed.ply FILE.ply",
                )
            if element != "vertex":
                raise _refused(f"its first element is {element!r}, not vertex", path)
        elif words[0] == "property":
            if len(words) != 3 or words[1] not in _TYPES or words[2] in dict(kinds):
                raise _refused(f"its header has {line.strip()[:80]!r}", path)
            kinds.append((words[2], _TYPES[words[1]]))
    if count < 0 or not kinds:
        raise _refused("it has no vertices", path)
    kind = np.dtype(kinds)
    if len(data) - start < count * kind.itemsize:
        raise _refused(f"it is cut short: {count} vertices of {kind.itemsize} bytes were announced", path)
    return np.frombuffer(data, kind, count, start)


def _refused(problem: str, path: Path) -> BadData:
    name = os.fspath(path)
    return BadData(
        f"Not Gaussians in the 3DGS layout: {problem}.", name, "Export the file again, as binary .ply."
    )
