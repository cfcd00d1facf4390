"""A finished artifact: a read-only folder whose every byte is checked when it is read."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from stages.shared.artifacts.arrays import Arrays, decode_arrays
from stages.shared.artifacts.canonical import digest, strict_json, unseal
from stages.shared.artifacts.external import DigestCache, file_digest
from stages.shared.artifacts.manifest import RUN_NAME, FileEntry, Manifest, is_plain_name, read_manifest
from stages.shared.errors import BadData, MissingInput


class Artifact:
    """What one run of one stage made.

    Attributes:
        path: its folder.
        manifest: what made it and what it holds.
    """

    def __init__(self, path: Path) -> None:
        """Open a finished folder; checks the manifest, and that every file is there in its size.

        Raises:
            BadData: damaged.
        """
        self.path = path
        self.manifest: Manifest = read_manifest(path)
        self._verified: set[str] = set()
        for name, entry in self.manifest.files.items():
            file = path / name
            if not file.is_file():
                raise self._damaged(name, "it is missing")
            if file.stat().st_size != entry.bytes:
                raise self._damaged(name, f"it has {file.stat().st_size} bytes instead of {entry.bytes}")

    @property
    def stage(self) -> str:
        return self.manifest.stage

    @property
    def key(self) -> str:
        return self.manifest.key

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the content, as later stages record it."""
        return self.manifest.digest

    @property
    def config(self) -> Any:
        """The configuration it was made with, as JSON types."""
        return self.manifest.config

    @property
    def summary(self) -> dict[str, Any]:
        """A few numbers to judge it by."""
        return self.manifest.summary

    @property
    def files(self) -> tuple[str, ...]:
        """Names of its files, sorted."""
        return tuple(sorted(self.manifest.files))

    @property
    def run(self) -> dict[str, Any]:
        """When and how fast it was made, with which libraries; not part of its content."""
        path = self.path / RUN_NAME
        try:
            return unseal(path.read_bytes(), path)
        except OSError as error:
            raise self._damaged(RUN_NAME, "it is missing") from error

    @property
    def records(self) -> dict[str, FileEntry]:
        """Files about the run that made it, by name; not part of its content. Raises BadData as `run`."""
        entries = self.run.get("records", {})
        try:
            records = {name: FileEntry(**entry) for name, entry in entries.items()}
        except (AttributeError, TypeError) as error:
            raise self._damaged(RUN_NAME, f"its records are not understood ({error})") from error
        if not all(is_plain_name(name) for name in records):
            raise self._damaged(RUN_NAME, "a record lies outside of the artifact")
        return records

    def record(self, name: str) -> bytes:
        """Content of a file about the run. Raises MissingInput, BadData as `arrays`."""
        entry = self.records.get(name)
        if entry is None:
            raise MissingInput(
                f"The artifact of {self.stage} holds no record {name!r}.", str(self.path), "Run it again."
            )
        try:
            data = (self.path / name).read_bytes()
        except OSError as error:
            raise self._damaged(name, "it is missing") from error
        if digest(data) != entry.sha256:
            raise self._damaged(name, "its content has changed")
        return data

    def has(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return name in self.manifest.files

    def arrays(self, name: str) -> Arrays:
        """All arrays of a safetensors file, writable copies in memory; the suffix may be left out.

        Raises:
            MissingInput: no such file in this artifact.
            BadData: its bytes are not the ones that were written, naming file and array.
        """
        name = self._name(name, ".safetensors")
        data = self._read(name)
        arrays, _ = decode_arrays(data, self.path / name)
        return arrays

    def json(self, name: str) -> Any:
        """Content of a JSON file; the suffix may be left out. Raises as `arrays`."""
        name = self._name(name, ".json")
        try:
            return strict_json(bytes(self._read(name)))
        except ValueError as error:
            raise self._damaged(name, f"it is not JSON ({error})") from error

    def bytes(self, name: str) -> bytes:
        """Content of any file. Raises as `arrays`."""
        return bytes(self._read(self._name(name, "")))

    def file(self, name: str) -> Path:
        """Path of a file whose content was checked, for libraries that open files. Raises as `arrays`."""
        name = self._name(name, "")
        if name not in self._verified:
            if file_digest(self.path / name) != self.manifest.files[name].sha256:
                raise self._damaged(name, "its content has changed")
            self._verified.add(name)
        return self.path / name

    def damaged_files(self, cache: DigestCache) -> list[str]:
        """Names of files whose content is not what was written; reads only those that may have changed."""
        recorded = self.manifest.files.items()
        return [name for name, entry in recorded if cache.digest(self.path / name) != entry.sha256]

    def _name(self, name: str, suffix: str) -> str:
        for candidate in (name, name + suffix):
            if candidate in self.manifest.files:
                return candidate
        raise MissingInput(
            f"The artifact of {self.stage} holds no file {name!r}; it has {', '.join(self.files) or 'none'}.",
            str(self.path),
            f"Run {self.stage} again with the options that write it.",
        )

    def _read(self, name: str) -> bytearray:
        data = bytearray(self.manifest.files[name].bytes)
        with (self.path / name).open("rb", buffering=0) as file:
            view, position = memoryview(data), 0
            while count := file.readinto(view[position:]):
                position += count
        if position != len(data) or digest(data) != self.manifest.files[name].sha256:
            raise self._damaged(name, "its content has changed")
        self._verified.add(name)
        return data

    def _damaged(self, name: str, what: str) -> BadData:
        return BadData(
            f"A file of a finished artifact is damaged: {what}.",
            str(self.path / name),
            f"Run `gw {self.path.parent.name}` again with --force; `gw verify` lists all that is damaged.",
        )

    def __repr__(self) -> str:
        return f"Artifact({self.path.parent.name}/{self.path.name})"
