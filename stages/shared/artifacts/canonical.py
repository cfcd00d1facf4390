"""Canonical JSON, one text for each value, and the digests made of it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.errors import BadData
from stages.shared.input_files import strict_json

KEY_LENGTH = 32  # hex characters; 128 bits name a folder without paths growing too long


def to_json(value: Any) -> Any:
    """A value as JSON types: dataclasses become objects, tuples lists, numpy values numbers.

    Dataclass fields marked `field(metadata={"affects_result": False})` (a device, a thread count) are left
    out: they change how fast a result comes, not what it is. Fields marked `{"omit_default": True}` (an
    option that was added later) are left out while they have their default, so earlier results keep their
    keys.

    Raises:
        ValueError: a number that is not finite.
        TypeError: any other type; also a path, because artifacts do not name places (give files as inputs).
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return to_json(value.tolist())
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{value} is not a finite number")
        return float(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json(getattr(value, field.name)) for field in _hashed_fields(value)}
    if isinstance(value, Mapping):
        return {str(name): to_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, set | frozenset):
        return sorted(to_json(item) for item in value)
    if isinstance(value, Path):
        raise TypeError(f"{value} is a path; give files as inputs, not as configuration")
    raise TypeError(f"{type(value).__name__} is not JSON")


def _hashed_fields(value: Any) -> list[dataclasses.Field[Any]]:
    """The fields of a dataclass instance that take part in keys and records."""
    return [
        field
        for field in dataclasses.fields(value)
        if field.metadata.get("affects_result", True)
        and not (field.metadata.get("omit_default") and getattr(value, field.name) == field.default)
    ]


def canonical_json(value: Any) -> bytes:
    """The canonical text of a value: sorted names, no spaces, UTF-8."""
    return json.dumps(
        to_json(value), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    ).encode()


def readable_json(value: Any) -> bytes:
    """As canonical, but with line breaks, for files people open."""
    text = json.dumps(to_json(value), sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False)
    return text.encode() + b"\n"


def digest(data: bytes | bytearray | memoryview) -> str:
    """SHA-256 as hex."""
    return hashlib.sha256(data).hexdigest()


def artifact_key(stage: str, schema: str, code_version: int, config: Any, inputs: Mapping[str, str]) -> str:
    """Name of what a stage makes from a configuration and inputs (name to digest)."""
    parts = {
        "stage": stage,
        "schema": schema,
        "code_version": code_version,
        "config": config,
        "inputs": dict(inputs),
    }
    return digest(canonical_json(parts))[:KEY_LENGTH]


def seal(value: dict[str, Any]) -> bytes:
    """A JSON file that carries its own SHA-256, so that a changed bit is detected."""
    return readable_json({**value, "sha256": digest(canonical_json(value))})


def unseal(data: bytes, path: Path) -> dict[str, Any]:
    """Read what `seal` wrote.

    Raises:
        BadData: not the bytes that were written.
    """
    try:
        value = strict_json(data)
        if not isinstance(value, dict):
            raise ValueError("not an object")
        claimed = value.pop("sha256", None)
        if claimed != digest(canonical_json(value)) or seal(value) != data:
            raise ValueError("it does not match its own checksum")
    except (ValueError, RecursionError) as error:
        raise BadData(
            f"A record of the workspace is damaged: {error}.",
            str(path),
            "Run the stage that wrote it again; `gw verify` lists everything that is damaged.",
        ) from error
    return value
