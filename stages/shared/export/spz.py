"""Gaussians as `.spz` (Niantic's format), version 3: about a tenth of the size of the `.ply`, with loss.

One gzip stream: a header of 16 bytes (magic, version, count as u32; harmonics' degree, fractional bits,
flags, 0 as u8), then one column after the other: positions as 24-bit fixed point, opacity, colour and log
scale as bytes, rotations as the three smallest components of the quaternion in 10 bits each. Axes are
right, up, back (OpenGL's), which is the world of `gw` as it is. Format: github.com/nianticlabs/spz, README.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts import write_whole
from stages.shared.errors import BadData, MissingInput
from stages.shared.splat.ply import HARMONIC, SplatCloud

MAGIC, VERSION = 0x5053474E, 3
COLOR_RANGE = 0.15  # of a byte's range per unit of the constant harmonic's coefficient
_HEADER = struct.Struct("<IIIBBBB")
_FINEST_BITS = 20  # a micrometre; readers admit at most 24
_FIXED_LIMIT = (1 << 23) - 1
_BYTES = 9 + 1 + 3 + 3 + 4  # per Gaussian
_MOST = 50_000_000
_ROOT_HALF = np.sqrt(0.5)


def write_spz(path: Path, cloud: SplatCloud) -> None:
    """Write the file whole or not at all; view dependence is left out.

    Rounding: positions to 2^-bits m with as many bits as the extent allows (20 within ±8 m), opacity to
    1/255, colour to 1/136, scales to 1/16 in the logarithm (at most 3.2 % off), rotations to about 0.1°.

    Raises BadData for numbers that are not finite or positions beyond 8,388 km.
    """
    for name in ("means", "quats", "scales", "opacities", "colors"):
        if not np.isfinite(getattr(cloud, name)).all():
            raise _refused(f"{name} has a value that is not finite", path)
    reach = float(np.abs(cloud.means).max(initial=0.0))
    bits = min(_FINEST_BITS, int(np.floor(np.log2(_FIXED_LIMIT / max(reach, 1e-9)))))
    if bits < 0:
        raise _refused("a position is beyond 8,388 km", path)
    fixed = np.rint(cloud.means.astype(np.float64) * (1 << bits)).astype("<i4")
    positions = fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    constant = (np.clip(cloud.colors, 0, 1) - 0.5) / HARMONIC
    columns = (
        positions,
        _bytes(cloud.opacities * 255),
        _bytes(constant * (COLOR_RANGE * 255) + 127.5),
        _bytes((np.log(np.maximum(cloud.scales, 1e-30)) + 10) * 16),
        pack_smallest_three(cloud.quats),
    )
    head = _HEADER.pack(MAGIC, VERSION, len(cloud), 0, bits, 0, 0)
    data = head + b"".join(column.tobytes() for column in columns)
    write_whole(path, gzip.compress(data, mtime=0))


def read_spz(path: Path) -> SplatCloud:
    """Read versions 2 and 3; harmonics beyond the constant are skipped.

    Raises MissingInput (no such file), BadData (another format, truncated, too large).
    """
    try:
        packed = path.read_bytes()
    except FileNotFoundError:
        raise MissingInput("There is no such file.", str(path), "Check the path.") from None
    if packed[:4] == struct.pack("<I", MAGIC):  # version 4 and later are not one gzip stream
        version = struct.unpack_from("<I", packed.ljust(8, b"\0"), 4)[0]
        raise BadData(
            f"This is .spz of version {version}; versions 2 and 3 are read.",
            str(path),
            "Save it as version 3, or as .ply, with the program that wrote it.",
        )
    data = _unzipped(packed, path)
    magic, version, count, _, bits, _, _ = _HEADER.unpack_from(data)
    if magic == MAGIC and version not in (2, 3):
        raise BadData(
            f"This is .spz of version {version}; versions 2 and 3 are read.",
            str(path),
            "Save it as version 3, or as .ply, with the program that wrote it.",
        )
    if magic != MAGIC or bits > 24:
        raise _refused(f"its header says {magic:#x}, version {version}, {bits} bits", path)
    turned_bytes = 4 if version == 3 else 3
    if len(data) < _HEADER.size + count * (_BYTES - 4 + turned_bytes):
        raise _refused(f"it is cut short: {count} Gaussians were announced", path)
    place = _HEADER.size

    def column(width: int) -> NDArray[np.uint8]:
        nonlocal place
        values = np.frombuffer(data, np.uint8, count * width, place).reshape(count, width)
        place += count * width
        return values

    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[:, :, 1:] = column(9).reshape(count, 3, 3)
    means = (fixed.reshape(count, 12).view("<i4") >> 8) / float(1 << bits)
    opacities = column(1)[:, 0] / 255.0
    constant = (column(3) / 255.0 - 0.5) / COLOR_RANGE
    scales = np.exp(column(3) / 16.0 - 10.0)
    quats = unpack_smallest_three(column(4)) if version == 3 else _first_three(column(3))
    colors = np.clip(0.5 + HARMONIC * constant, 0, 1)
    means32, quats32, scales32, opacities32, colors32 = (
        values.astype(np.float32) for values in (means, quats, scales, opacities, colors)
    )
    return SplatCloud(means32, quats32, scales32, opacities32, colors32)


def pack_smallest_three(quats: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(N, 4) bytes of quaternions (N, 4) wxyz: index of the largest component, then sign and 9 bits of each
    other one, in the order x y z w, as one little-endian number."""
    xyzw = np.roll(quats.astype(np.float64), -1, axis=1)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    rows = np.arange(len(xyzw))
    xyzw *= np.where(xyzw[rows, largest] < 0, -1.0, 1.0)[:, None]
    packed = largest.astype(np.uint32)
    for axis in range(4):
        size = np.minimum(np.floor(511 * np.abs(xyzw[:, axis]) / _ROOT_HALF + 0.5), 511).astype(np.uint32)
        code = (xyzw[:, axis] < 0).astype(np.uint32) << np.uint32(9) | size
        packed = np.where(axis == largest, packed, packed << np.uint32(10) | code)
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def unpack_smallest_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N, 4) unit quaternions wxyz of what `pack_smallest_three` wrote."""
    codes = np.ascontiguousarray(packed).view("<u4")[:, 0].copy()
    largest = codes >> np.uint32(30)
    xyzw = np.zeros((len(codes), 4))
    for axis in (3, 2, 1, 0):
        here = axis != largest
        value = (codes & np.uint32(511)) / 511 * _ROOT_HALF
        value = np.where(codes & np.uint32(512), -value, value)
        xyzw[here, axis] = value[here]
        codes = np.where(here, codes >> np.uint32(10), codes)
    rest = np.sqrt(np.maximum(1 - np.square(xyzw).sum(axis=1), 0))
    xyzw[np.arange(len(xyzw)), largest] = rest
    return np.roll(xyzw, 1, axis=1)


def _first_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Version 2: x y z in a byte each, w ≥ 0 left out."""
    xyz = packed / 127.5 - 1.0
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1), 0))
    wxyz = np.column_stack([w, xyz])
    return wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _unzipped(packed: bytes, path: Path) -> bytes:
    """The stream, with a bound that its own header sets: nothing can blow up in memory."""
    reader = zlib.decompressobj(wbits=31)
    try:
        head = reader.decompress(packed, _HEADER.size)
        if len(head) < _HEADER.size:
            raise _refused("it is too short", path)
        count, degree = _HEADER.unpack(head)[2:4]
        if count > _MOST or degree > 4:
            raise _refused(f"its header announces {count} Gaussians of degree {degree}", path)
        size = count * (_BYTES + 3 * ((degree + 1) ** 2 - 1))
        body = reader.decompress(reader.unconsumed_tail, size) if size else b""
        return head + body
    except zlib.error as error:
        raise _refused(f"it is no gzip stream ({error})", path) from error


def _refused(problem: str, path: Path) -> BadData:
    return BadData(f"Not Gaussians as .spz: {problem}.", str(path), "Export the file again.")
