"""Reading of files that other programs wrote: regular files up to a maximum size.

Every reader of text and JSON uses this module. So byte order marks, UTF-16, sizes, repeated names, huge
numbers and deep nesting are treated in one way.
"""

from __future__ import annotations

import codecs
import json
import math
import stat
from pathlib import Path
from typing import Any

from stages.shared.errors import BadData, MissingInput, StorageFailure

TEXT_BYTES = 1 << 30
JSON_BYTES = 16 << 20
CANONICAL = "canonical"
"""Typed in place of a pose file: one frame in the canonical pose of the maps."""
_LARGEST_INTEGER = 1 << 64
_BYTE_ORDER_MARKS = (  # UTF-32 comes first: its little-endian mark begins with the one of UTF-16
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)


def check_input_file(path: Path, what: str, limit: int | None = None) -> int:
    """Size in bytes of a file, without opening it.

    Arguments:
        path: the file.
        what: what it should be, for messages ("a pose file").
        limit: largest size in bytes.

    Raises:
        MissingInput: no such file.
        BadData: a folder, a pipe or a device, or a file that is larger than `limit`.
        StorageFailure: the file system refuses to answer.
    """
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MissingInput(f"There is no file for {what}.", str(path), "Check the path.") from error
    except ValueError as error:  # a NUL character in the name
        raise MissingInput(f"There is no file for {what}.", repr(str(path)), "Check the path.") from error
    except OSError as error:
        raise _unreadable(path, error) from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, a socket or a device"
        raise BadData(f"This is {kind}, not {what}.", str(path), "Give a regular file.")
    if limit is not None and status.st_size > limit:
        raise BadData(
            f"The file has {status.st_size} bytes; at most {limit} are read for {what}.",
            str(path),
            "Check that this is the right file.",
        )
    return status.st_size


def read_input(path: Path, what: str, limit: int | None = None) -> bytes:
    """The content of a regular file. Arguments and errors as `check_input_file`."""
    check_input_file(path, what, limit)
    try:
        return path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Text of UTF-8 bytes, or of UTF-16 and UTF-32 with a byte order mark; the mark is removed.

    UTF-16 without a mark is recognised where the first characters are ASCII: every other byte is zero.

    Raises:
        UnicodeDecodeError: other bytes, with `errors` "strict".
    """
    for mark, encoding in _BYTE_ORDER_MARKS:
        if data.startswith(mark):
            return data[len(mark) :].decode(encoding, errors)
    opening = data[:8]
    if len(opening) == 8 and not any(opening[1::2]) and all(opening[::2]):
        return data.decode("utf-16-le", errors)
    if len(opening) == 8 and not any(opening[::2]) and all(opening[1::2]):
        return data.decode("utf-16-be", errors)
    return data.decode("utf-8", errors)


def without_mark(data: bytes) -> bytes:
    """The bytes of a text file as UTF-8 without a byte order mark; bytes without a mark are not changed."""
    if any(data.startswith(mark) for mark, _ in _BYTE_ORDER_MARKS):
        return decode_text(data, "replace").encode()
    return data


def read_text(path: Path, what: str, limit: int = TEXT_BYTES, errors: str = "strict") -> str:
    """The text of a file, without its byte order mark.

    Raises:
        BadData: not text; otherwise as `check_input_file`.
    """
    try:
        return decode_text(read_input(path, what, limit), errors)
    except UnicodeDecodeError as error:
        raise BadData(
            f"The file is not UTF-8 text: byte {error.start} does not fit.",
            str(path),
            "Save it as UTF-8.",
        ) from error


def strict_json(data: bytes) -> Any:
    """A value out of UTF-8 JSON as the standard has it: finite numbers, and no name twice in one object.

    Raises:
        ValueError: anything else; also integers beyond 64 bits, and nesting that is too deep.
    """
    return _parse_json(data.decode("utf-8"))


def read_json(path: Path, what: str, limit: int = JSON_BYTES) -> Any:
    """The value in a JSON file; as `strict_json`, with or without a byte order mark.

    Raises:
        BadData: not JSON; otherwise as `check_input_file`.
    """
    data = read_input(path, what, limit)
    try:
        return _parse_json(decode_text(data))
    except ValueError as error:
        raise BadData(
            f"This file cannot be read as {what}: it is not valid JSON ({error}).",
            str(path),
            "Correct the file, or write it again.",
        ) from error


def read_json_object(path: Path, what: str, limit: int = JSON_BYTES) -> dict[str, Any]:
    """The object in a JSON file. Raises BadData for any other value; otherwise as `read_json`."""
    value = read_json(path, what, limit)
    if not isinstance(value, dict):
        raise BadData(
            f"This file cannot be read as {what}: it does not hold a JSON object.",
            str(path),
            "Correct the file, or write it again.",
        )
    return value


def _parse_json(text: str) -> Any:
    try:
        return json.loads(
            text,
            parse_constant=_refuse_constant,
            parse_float=_finite_number,
            parse_int=_bounded_integer,
            object_pairs_hook=_unique_names,
        )
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def _finite_number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:40]} is beyond what 64 bits can hold")
    return value


def _bounded_integer(text: str) -> int:
    value = int(text) if len(text) <= 21 else _LARGEST_INTEGER
    if abs(value) >= _LARGEST_INTEGER:
        raise ValueError(f"the integer {text[:40]} is beyond what 64 bits can hold")
    return value


def _unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the name {twice[:80]!r} stands twice in one object")
    return value


def _unreadable(path: Path, error: OSError) -> StorageFailure:
    return StorageFailure(
        f"Reading failed: {error.strerror or error}.", str(path), "Check the disk and the permissions."
    )
