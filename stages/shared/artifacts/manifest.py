"""The manifest of an artifact: what made it and what it holds, without dates or paths."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stages.shared.artifacts.canonical import artifact_key, canonical_json, digest, seal, to_json, unseal
from stages.shared.errors import BadData

MANIFEST_NAME = "manifest.json"
RUN_NAME = "run.json"
STORE_MAJOR = 1
_HEX = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class FileEntry:
    """Size in bytes and SHA-256 of one file of an artifact."""

    bytes: int
    sha256: str


@dataclass(frozen=True)
class InputEntry:
    """One input: another artifact (`stage`, `key`), or external files (`root`: setting, `listing`: file)."""

    digest: str
    stage: str | None = None
    key: str | None = None
    root: str | None = None
    listing: str | None = None
    count: int | None = None


@dataclass(frozen=True)
class Manifest:
    """What an artifact is made of. Equal manifests mean equal artifacts."""

    stage: str
    schema: str
    code_version: int
    config: Any
    inputs: dict[str, InputEntry] = field(default_factory=dict)
    files: dict[str, FileEntry] = field(default_factory=dict)
    arrays: dict[str, dict[str, Any]] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Name of the artifact's folder: everything that determines its content."""
        digests = {name: entry.digest for name, entry in self.inputs.items()}
        return artifact_key(self.stage, self.schema, self.code_version, self.config, digests)

    @property
    def digest(self) -> str:
        """SHA-256 over all of it, hence over every file's digest: what later stages record as their input."""
        return digest(canonical_json(self._value()))

    def to_bytes(self) -> bytes:
        return seal(self._value())

    def _value(self) -> dict[str, Any]:
        value: dict[str, Any] = to_json(self)
        value["store"] = STORE_MAJOR
        value["inputs"] = {
            name: {part: text for part, text in entry.items() if text is not None}
            for name, entry in value["inputs"].items()
        }
        return value


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a finished artifact.

    Raises:
        BadData: damaged, or written by a newer version of the store.
    """
    path = folder / MANIFEST_NAME
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _damaged(path, f"it cannot be read ({error.strerror})") from error
    value = unseal(data, path)
    store = value.pop("store", None)
    if store != STORE_MAJOR:
        raise BadData(
            f"This artifact was written for version {store} of the store; this gw reads {STORE_MAJOR}.",
            str(path),
            "Use the gw that wrote it, or run the stage again.",
        )
    try:
        manifest = Manifest(
            stage=_text(value.pop("stage")),
            schema=_text(value.pop("schema")),
            code_version=int(value.pop("code_version")),
            config=value.pop("config"),
            inputs={name: InputEntry(**entry) for name, entry in value.pop("inputs").items()},
            files={name: FileEntry(**entry) for name, entry in value.pop("files").items()},
            arrays=dict(value.pop("arrays")),
            summary=dict(value.pop("summary")),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _damaged(path, f"a part is missing or wrong ({error})") from error
    for name, entry in manifest.files.items():
        if not is_plain_name(name) or type(entry.bytes) is not int or not _HEX.fullmatch(str(entry.sha256)):
            raise _damaged(path, f"its entry of file {name!r} is wrong")
    if manifest.key != folder.name:
        raise _damaged(path, "its content does not belong to the folder it is in")
    return manifest


def is_plain_name(name: str) -> bool:
    """Whether a name stays inside its artifact: relative, forward slashes, no hidden parts, no '..'."""
    parts = name.split("/")
    return all(part and not part.startswith(".") and "\\" not in part and "\0" not in part for part in parts)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


def _damaged(path: Path, what: str) -> BadData:
    return BadData(f"The manifest is damaged: {what}.", str(path), "Run the stage that wrote it again.")
