"""The wardrobe file `.gwg`: a body or a garment, whole, in one safetensors file.

The header's metadata holds a JSON manifest (`gwg`) and its SHA-256 (`gwg_sha256`); the manifest holds the
SHA-256 of every tensor. The same content always gives the same bytes: every byte of a file is either
digested or must be exactly what `write_bundle` would write. A bundle holds no program, path or date. A reader
checks every number before it uses it.
"""

from __future__ import annotations

import json
import os
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.artifacts.arrays import Arrays, decode_arrays, encode_arrays
from stages.shared.artifacts.bundle_content import check_arrays, check_layout, check_manifest
from stages.shared.artifacts.canonical import canonical_json, digest, strict_json, to_json
from stages.shared.artifacts.files import write_whole
from stages.shared.errors import BadData, MissingInput, StorageFailure

SCHEMA = {"name": "gwg", "major": 1, "minor": 2}
MAX_FILE_BYTES = 512 << 20
MAX_HEADER_BYTES = 1 << 20
MAX_TENSORS = 1024  # three full-size networks have 666
MAX_RANK = 5
MAX_SIDE = 1 << 24
MAX_TEXT = 4096
MAX_DEPTH = 16
_DTYPES = ("F32", "F16", "I32", "U8")
_MANIFEST, _SEAL = "gwg", "gwg_sha256"
_NAME = re.compile(r"(?:maps|model|swap|skin|body|cloth)/[A-Za-z0-9_.]{1,120}|preview|betas|joints")


@dataclass(frozen=True, eq=False)
class Bundle:
    """What a `.gwg` file holds.

    Attributes:
        manifest: plain JSON; what it must say is in `bundle_content.py`. Schema and tensor digests are added
            on writing.
        arrays: name to array: `maps/…`, `model/…`, `swap/…`, `skin/…`, `body/…`, `cloth/…`, `betas`,
            `joints`, `preview`.
        digest: SHA-256 of the manifest with all tensor digests: names the content. Empty until written.
    """

    manifest: dict[str, Any]
    arrays: Arrays
    digest: str = ""

    @property
    def kind(self) -> str:
        """ "body" or "garment"."""
        return str(self.manifest["kind"])

    @property
    def layer(self) -> str:
        """ "body", "lower", "upper" or "outer"."""
        return str(self.manifest["layer"])

    def group(self, prefix: str) -> Arrays:
        """The arrays whose names begin with `prefix/`, without it."""
        return {
            name[len(prefix) + 1 :]: a for name, a in self.arrays.items() if name.startswith(prefix + "/")
        }


def encode_bundle(bundle: Bundle, where: str = "bundle") -> list[memoryview]:
    """The bytes of a bundle, in chunks; checked like a file from a stranger before a byte leaves.

    Raises:
        BadData: what would not be accepted on reading.
    """
    arrays = {name: np.ascontiguousarray(array) for name, array in bundle.arrays.items()}
    tensors = {name: {"sha256": _array_digest(array)} for name, array in arrays.items()}
    manifest = to_json({**bundle.manifest, "schema": SCHEMA, "tensors": tensors})
    _check_plain(manifest, where)
    check_manifest(manifest, where)
    check_arrays(manifest, arrays, where)
    text = canonical_json(manifest)
    chunks = encode_arrays(arrays, where, {_MANIFEST: text.decode(), _SEAL: digest(text)})
    _checked_header(bytes(chunks[0])[8:], sum(map(len, chunks[1:])), where)
    if sum(map(len, chunks)) > MAX_FILE_BYTES:
        raise _refused(f"it would have more than {MAX_FILE_BYTES} bytes", where)
    return chunks


def write_bundle(path: Path, bundle: Bundle) -> str:
    """Write a `.gwg` file, whole or not at all; returns its digest.

    Raises:
        BadData: the content is not what a bundle may hold. StorageFailure: disk full, no permission.
    """
    chunks = encode_bundle(bundle, str(path))
    write_whole(Path(path), chunks)
    header = json.loads(bytes(chunks[0])[8:])
    return str(header["__metadata__"][_SEAL])


def read_bundle(path: Path, max_bytes: int = MAX_FILE_BYTES) -> Bundle:
    """Read and check a `.gwg` file: header, bounds, digests, meaning, in this order.

    Raises:
        MissingInput: no such file. BadData: naming the file and what in it is wrong.
        StorageFailure: the file cannot be read.
    """
    path = Path(path)
    return decode_bundle(read_bundle_bytes(path, max_bytes), str(path))


def read_bundle_bytes(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytearray:
    """The bytes of a `.gwg` file, for `decode_bundle`; raises MissingInput, BadData, StorageFailure."""
    return _read(Path(path), max_bytes)[0]


@dataclass(frozen=True)
class BundleCard:
    """What the header of a bundle says.

    Attributes:
        manifest: as in `Bundle`. digest: as written; not compared with the tensors.
        tensors: name to (type, shape). bytes: of the file.
    """

    manifest: dict[str, Any]
    digest: str
    tensors: dict[str, tuple[str, tuple[int, ...]]]
    bytes: int


def read_card(path: Path, max_bytes: int = MAX_FILE_BYTES) -> BundleCard:
    """The header of a `.gwg` file, checked; its tensors are not read. Raises like `read_bundle`."""
    path = Path(path)
    where = str(path)
    data, size = _read(path, max_bytes, header_only=True)
    header = _header_bytes(data, where)
    _checked_header(header, size - 8 - len(header), where)
    entries = strict_json(header)
    manifest, seal = _sealed_manifest(entries.pop("__metadata__"), where)
    if set(manifest.pop("tensors")) != set(entries):
        raise _refused("its manifest speaks of other tensors than it holds", where)
    tensors = {name: (str(entry["dtype"]), tuple(entry["shape"])) for name, entry in entries.items()}
    check_layout(manifest, tensors, where)
    return BundleCard(manifest, seal, tensors, size)


def decode_bundle(data: bytearray, where: str) -> Bundle:
    """A bundle out of the bytes of a file. Raises BadData as `read_bundle`."""
    header = _header_bytes(data, where)
    _checked_header(header, len(data) - 8 - len(header), where)
    arrays, notes = decode_arrays(data, Path(where))
    manifest, seal = _sealed_manifest(notes, where)
    tensors = manifest["tensors"]
    if set(tensors) != set(arrays):
        raise _refused("its manifest speaks of other tensors than it holds", where)
    for name, array in arrays.items():
        if tensors[name] != {"sha256": _array_digest(array)}:
            raise _refused("the content of a tensor does not match its checksum", f"{where}, tensor {name!r}")
    check_arrays(manifest, arrays, where)
    if bytes(encode_arrays(arrays, where, notes)[0])[8:] != header:
        raise _refused("its header is not written as bundles are", where)
    manifest.pop("tensors")
    return Bundle(manifest, arrays, seal)


def _read(path: Path, max_bytes: int, header_only: bool = False) -> tuple[bytearray, int]:
    """All bytes of a file whose size is acceptable, or those of its header; and that size."""
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise _refused("it is a pipe or a device, not a file", str(path))
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > max_bytes:
                raise _refused(f"it has {size} bytes, more than {max_bytes}", str(path))
            head = stream.read(8)
            if len(head) == 8 and struct.unpack("<Q", head)[0] > min(MAX_HEADER_BYTES, size - 8):
                raise _refused("its header claims more bytes than are allowed or there", str(path))
            # As many bytes as are there: a read allocates what it is asked for, not what it finds.
            rest = struct.unpack("<Q", head)[0] if header_only and len(head) == 8 else max(size - 8, 0)
            return bytearray(head + stream.read(rest)), size
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        raise MissingInput(
            "There is no such bundle.", str(path), "Export one: gw export-garment SUBJECT --layer NAME."
        ) from error
    except OSError as error:
        raise StorageFailure(f"Reading failed: {error.strerror}.", str(path), "Check the disk.") from error


def _header_bytes(data: bytearray, where: str) -> bytes:
    if len(data) < 8:
        raise _refused(f"it has only {len(data)} bytes", where)
    (length,) = struct.unpack_from("<Q", data)
    if length > MAX_HEADER_BYTES or 8 + length > len(data):
        raise _refused(f"its header claims {length} bytes", where)
    return bytes(data[8 : 8 + length])


def _checked_header(header: bytes, data_bytes: int, where: str) -> None:
    """Bounds of every tensor, before anything is allocated for it."""
    try:
        entries = strict_json(header)
    except (ValueError, RecursionError) as error:
        raise _refused(f"its header is not JSON ({error})", where) from error
    if not isinstance(entries, dict) or not isinstance(entries.get("__metadata__"), dict):
        raise _refused("its header is not that of a bundle", where)
    names = [name for name in entries if name != "__metadata__"]
    if len(names) > MAX_TENSORS:
        raise _refused(f"it holds {len(names)} tensors, more than {MAX_TENSORS}", where)
    for name in names:
        entry = entries[name]
        at = f"{where}, tensor {name[:80]!r}"
        if not _NAME.fullmatch(name):
            raise _refused("it holds a tensor whose name means nothing", at)
        if not isinstance(entry, dict) or entry.get("dtype") not in _DTYPES:
            raise _refused(f"a tensor is not of the types {', '.join(_DTYPES)}", at)
        shape = entry.get("shape")
        if (
            not isinstance(shape, list)
            or len(shape) > MAX_RANK
            or not all(type(side) is int and 0 <= side <= MAX_SIDE for side in shape)
        ):
            raise _refused(f"the shape {str(shape)[:80]} is not possible", at)
        offsets = entry.get("data_offsets")
        if not isinstance(offsets, list) or not all(type(o) is int and 0 <= o <= data_bytes for o in offsets):
            raise _refused("a tensor lies outside the file", at)


def _sealed_manifest(notes: dict[str, Any], where: str) -> tuple[dict[str, Any], str]:
    """The manifest in the metadata of a file, checked, and its digest."""
    if set(notes) != {_MANIFEST, _SEAL} or not all(isinstance(note, str) for note in notes.values()):
        raise _refused("its metadata is not that of a bundle", where)
    text = notes[_MANIFEST].encode()
    if digest(text) != notes[_SEAL]:
        raise _refused("its manifest does not match its checksum", where)
    return _manifest(text, where), notes[_SEAL]


def _manifest(text: bytes, where: str) -> dict[str, Any]:
    try:
        manifest = strict_json(text)
    except (ValueError, RecursionError) as error:
        raise _refused(f"its manifest is not JSON ({error})", where) from error
    if not isinstance(manifest, dict):
        raise _refused("its manifest is not an object", where)
    schema = manifest.get("schema")
    if not isinstance(schema, dict) or schema.get("name") != SCHEMA["name"]:
        raise _refused("it is not a wardrobe bundle", where)
    if type(schema.get("major")) is not int or type(schema.get("minor")) is not int:
        raise _refused("its schema version is not two numbers", where)
    if schema["major"] != SCHEMA["major"]:
        raise BadData(
            f"The bundle has schema version {schema['major']}.{schema['minor']}; this program reads "
            f"{SCHEMA['major']}.{SCHEMA['minor']}.",
            where,
            "Update gw, or export the bundle again with this version.",
        )
    _check_plain(manifest, where)
    check_manifest(manifest, where)
    try:
        rewritten = canonical_json(manifest)
    except ValueError as error:  # a number beyond what a float can hold
        raise _refused(f"its manifest holds a number that is not finite ({error})", where) from error
    if rewritten != text:
        raise _refused("its manifest is not written as bundles are", where)
    return manifest


def _check_plain(value: Any, where: str, depth: int = 0) -> None:
    """Bounded depth and text length, and no text that looks like an absolute path."""
    if depth > MAX_DEPTH:
        raise _refused(f"its manifest is nested deeper than {MAX_DEPTH}", where)
    if isinstance(value, Mapping):
        for name, item in value.items():
            _check_plain(name, where, depth + 1)
            _check_plain(item, where, depth + 1)
    elif isinstance(value, list):
        for item in value:
            _check_plain(item, where, depth + 1)
    elif isinstance(value, str):
        if len(value.encode()) > MAX_TEXT:
            raise _refused(f"a text in its manifest is longer than {MAX_TEXT} bytes", where)
        if value.startswith(("/", "~", "\\")) or re.match(r"[A-Za-z]:[\\/]", value):
            raise _refused(f"its manifest names a place on a disk ({value[:40]!r})", where)


def _array_digest(array: np.ndarray) -> str:
    """SHA-256 of type, shape and values, little-endian."""
    array = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    mark = f"{array.dtype.str} {list(array.shape)} ".encode()
    return digest(mark + array.tobytes())


def _refused(what: str, where: str) -> BadData:
    return BadData(
        f"The bundle cannot be used: {what}.",
        where,
        "Fetch a whole copy, or export it again from its subject.",
    )
