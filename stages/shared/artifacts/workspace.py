"""A subject's workspace: the artifacts of all stages, which of them are in use, and the settings."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stages.shared.artifacts import lock
from stages.shared.artifacts.artifact import Artifact
from stages.shared.artifacts.build import Build
from stages.shared.artifacts.canonical import (
    KEY_LENGTH,
    artifact_key,
    readable_json,
    seal,
    strict_json,
    to_json,
    unseal,
)
from stages.shared.artifacts.external import DigestCache, ExternalFiles, listing_digest
from stages.shared.artifacts.files import make_folders, remove_folder, write_whole
from stages.shared.artifacts.leftovers import acquire_writer, progress_path, writing
from stages.shared.artifacts.manifest import InputEntry, is_plain_name
from stages.shared.artifacts.progress import Progress
from stages.shared.artifacts.spec import StageResult, StageSpec
from stages.shared.errors import BadData, Locked, MissingInput, StorageFailure
from stages.shared.report import Report

SETTINGS_NAME = "subject.json"
CURRENT_NAME = "current.json"
_KEY = re.compile(rf"[0-9a-f]{{{KEY_LENGTH}}}")
Inputs = Mapping[str, Artifact | ExternalFiles]


class Workspace:
    """The folder of one subject.

    - `subject.json`: where the capture is, relative to this folder
    - `<stage>/current.json`: which artifact of the stage is in use
    - `<stage>/<key>/manifest.json`, …: a finished artifact, whole, read-only, named by what made it
    - `.<stage>.tmp-…`, `.<stage>.progress-…`: work that is not finished
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)

    def current(self, spec: StageSpec) -> Artifact | None:
        """The artifact of a stage that is in use, or None.

        Raises:
            BadData: there is one, but it is damaged.
        """
        pointer = self.root / spec.name / CURRENT_NAME
        if not pointer.exists():
            return None
        key = unseal(pointer.read_bytes(), pointer).get("key")
        folder = self.root / spec.name / str(key)
        return Artifact(folder) if folder.is_dir() else None

    def require(self, spec: StageSpec) -> Artifact:
        """The artifact of a stage that is in use.

        Raises:
            MissingInput: there is none; says which command makes it.
            BadData: it is damaged, or of a schema that this version does not read; no folder.
        """
        if self.root.is_file():
            raise BadData("This is a file, not a subject.", str(self.root), "Give the folder of a subject.")
        artifact = self.current(spec)
        if artifact is None:
            raise MissingInput(
                f"The stage {spec.name} has not been run for this subject.",
                str(self.root),
                f"Run: {self.command(spec)}",
            )
        written = artifact.manifest.schema
        if written.split(".")[0] != spec.schema.split(".")[0]:
            raise BadData(
                f"The artifact of {spec.name} has schema {written}; this gw reads {spec.schema}.",
                str(artifact.path),
                f"Use the gw that wrote it, or run again: {self.command(spec)}",
            )
        return artifact

    def find(self, spec: StageSpec, config: Any, inputs: Inputs) -> Artifact | None:
        """The finished artifact that this configuration and these inputs give, put in use; or None.

        Raises:
            MissingInput: an input file is not there.
        """
        cache = DigestCache(self.root)
        key = self._key(spec, config, inputs, cache)
        folder = self.root / spec.name / key
        if not folder.is_dir():
            return None
        try:
            artifact = Artifact(folder)
        except BadData:
            return None  # the caller makes it again and replaces it
        damaged = artifact.damaged_files(cache)
        with contextlib.suppress(StorageFailure):  # looking works on a read-only disk too
            cache.save()
        if damaged:
            return None
        if not self._is_current(artifact):
            with self.writing():
                self.set_current(artifact)
        elif progress_path(self.root, spec.name, key).exists():
            # A kill came between the end of the work and its clean-up; a busy workspace is cleaned up later.
            with contextlib.suppress(Locked), self.writing():
                remove_folder(progress_path(self.root, spec.name, key))
        return artifact

    def reuse(
        self, spec: StageSpec, config: Any, inputs: Inputs, report: Report, force: bool = False
    ) -> StageResult | None:
        """The result of a stage that is up to date, after saying so; None when it has to run.

        Raises:
            MissingInput: an input file is not there.
        """
        artifact = None if force else self.find(spec, config, inputs)
        if artifact is None:
            return None
        report.say(f"{spec.name} is up to date")
        return StageResult(artifact, artifact.summary)

    def build(self, spec: StageSpec, config: Any, inputs: Inputs, force: bool = False) -> Build:
        """Make an artifact: `with workspace.build(...) as build: build.write_arrays(...)`; `build.artifact`.

        Takes the lock for the length of the block. An artifact already there under the same key stays if its
        content is whole and the same, unless `force` is set.

        Entering the block raises:
            Locked: another process writes to this workspace.
            MissingInput: an input file is not there.
            StorageFailure: disk full; nothing half-written is left.
        """
        return Build(self, spec, config, inputs, force)

    def progress(self, spec: StageSpec, config: Any, inputs: Inputs, force: bool = False) -> Progress:
        """Folder for unfinished work of a long stage: `with workspace.progress(...)`.

        The same configuration and inputs give the same folder again after a crash, until their artifact is
        finished. `force` starts it empty.

        Raises:
            Locked: another process writes to this workspace.
        """
        acquire_writer(self.root)
        try:
            key = self._key(spec, config, inputs, DigestCache(self.root))
            folder = progress_path(self.root, spec.name, key)
            if force:
                remove_folder(folder)
            make_folders(folder)
        except BaseException:
            lock.release(self.root)
            raise
        return Progress(folder, lambda: lock.release(self.root))

    def settings(self) -> dict[str, Any]:
        """What `subject.json` holds; empty for a new workspace.

        Raises:
            BadData: it is not JSON.
        """
        path = self.root / SETTINGS_NAME
        if not path.exists():
            return {}
        try:
            value = strict_json(path.read_bytes())
            if not isinstance(value, dict):
                raise ValueError("not an object")
        except ValueError as error:
            raise BadData(
                f"The subject's settings cannot be read: {error}.", str(path), "Repair it, or register again."
            ) from error
        return value

    def save_settings(self, **values: Any) -> None:
        """Add to `subject.json`. Paths become relative to the workspace, so that both can be moved together.

        Raises:
            Locked: another process writes to this workspace.
        """
        texts = {name: self.relative(value) for name, value in values.items() if isinstance(value, Path)}
        values = to_json(values | texts)
        settings = self.settings()
        if settings | values == settings and (self.root / SETTINGS_NAME).exists():
            return
        with self.writing():
            write_whole(self.root / SETTINGS_NAME, readable_json(self.settings() | values))

    def setting_path(self, name: str) -> Path:
        """A path that `subject.json` holds, e.g. "capture", as seen from here.

        Raises:
            MissingInput: the setting, or what it points at, is not there.
        """
        text = self.settings().get(name)
        if not isinstance(text, str):
            raise MissingInput(
                f"This subject has no {name}.", str(self.root / SETTINGS_NAME), "Run gw register-template."
            )
        path = self._seen_from_here(text)
        if not path.exists():
            raise MissingInput(
                f"The {name} of this subject is not where it was.",
                str(path),
                f"Put it back, or write its new place into {self.root / SETTINGS_NAME}.",
            )
        return path

    def relative(self, path: Path) -> str:
        """A path as text relative to this workspace."""
        return Path(os.path.relpath(path.resolve(), self.root.resolve())).as_posix()

    def publish(self, artifact: Artifact, file_name: str, as_name: str) -> Path:
        """Copy a file of an artifact, whole or not at all, to a place where users look for it.

        Call it for an artifact that `find` gave too: the process that built it may have been killed before it
        came to this, and another artifact's copy may stand there. Nothing is written if it is there already.
        """
        if not is_plain_name(as_name):
            raise ValueError(f"{as_name!r} is not a name inside the workspace")
        target = self.root / as_name
        data = artifact.bytes(file_name)
        if target.exists() and target.read_bytes() == data:
            return target
        with self.writing():
            write_whole(target, data)
        return target

    def command(self, spec: StageSpec) -> str:
        """What a user types to run a stage for this subject."""
        capture = self.settings().get("capture")
        words = {"SUBJECT": str(self.root)}
        if isinstance(capture, str):
            words["CAPTURE"] = str(self._seen_from_here(capture))
        return " ".join(words.get(word, word) for word in spec.command.split())

    def _seen_from_here(self, text: str) -> Path:
        """A path of the settings, absolute or relative as this workspace's own is."""
        path = (self.root / text).resolve()
        return path if self.root.is_absolute() else Path(os.path.relpath(path))

    def writing(self) -> contextlib.AbstractContextManager[None]:
        """Be the writer inside the block. Raises Locked when another process is."""
        return writing(self.root)

    def artifacts(self) -> list[Path]:
        """Folders of all finished artifacts, in use or not."""
        return sorted(folder for folder in self.root.glob("*/*/") if _KEY.fullmatch(folder.name))

    def set_current(self, artifact: Artifact) -> None:
        """Put an artifact in use. The caller holds the lock."""
        if not self._is_current(artifact):
            write_whole(self.root / artifact.stage / CURRENT_NAME, seal({"key": artifact.key}))

    def _is_current(self, artifact: Artifact) -> bool:
        pointer = self.root / artifact.stage / CURRENT_NAME
        return pointer.exists() and pointer.read_bytes() == seal({"key": artifact.key})

    def register_inputs(self, inputs: Inputs) -> tuple[dict[str, InputEntry], dict[str, dict[str, str]]]:
        """Digest all inputs of a build and remember where the external ones are. The caller holds the lock.

        Returns:
            What the manifest records of each input, and the listings of external files by file name.
        """
        cache = DigestCache(self.root)
        entries, listings = self._entries(inputs, cache)
        cache.save()
        self._remember_roots(inputs)
        return entries, listings

    def _key(self, spec: StageSpec, config: Any, inputs: Inputs, cache: DigestCache) -> str:
        entries, _ = self._entries(inputs, cache)
        digests = {name: entry.digest for name, entry in entries.items()}
        return artifact_key(spec.name, spec.schema, spec.code_version, config, digests)

    def _entries(
        self, inputs: Inputs, cache: DigestCache
    ) -> tuple[dict[str, InputEntry], dict[str, dict[str, str]]]:
        """Inputs as the manifest records them, and the listings of external files."""
        entries, listings = {}, {}
        for name, source in inputs.items():
            if isinstance(source, Artifact):
                entries[name] = InputEntry(source.digest, stage=source.stage, key=source.key)
                continue
            listing = source.listing(cache)
            file = f"inputs/{name.replace('/', '-')}.json"
            listings[file] = listing
            entries[name] = InputEntry(
                listing_digest(listing), root=self._root_setting(source), listing=file, count=len(listing)
            )
        return entries, listings

    def _remember_roots(self, inputs: Inputs) -> None:
        """Write into `subject.json` where external files are, unless it says so already."""
        for source in inputs.values():
            if isinstance(source, ExternalFiles):
                name = self._root_setting(source)
                if not self._leads_to(name, source.root):
                    self.save_settings(**{name: source.root})

    def _root_setting(self, source: ExternalFiles) -> str:
        """Name of the setting that says where these files are.

        The one the group is named after; a second name only where the first leads to something else that is
        there, e.g. to a file in that folder.
        """
        text = self.settings().get(source.setting)
        taken = (
            text is not None
            and (self.root / str(text)).exists()
            and not self._leads_to(source.setting, source.root)
        )
        return f"{source.setting}_root" if taken else source.setting

    def _leads_to(self, setting: str, folder: Path) -> bool:
        text = self.settings().get(setting)
        return isinstance(text, str) and (self.root / text).resolve() == folder.resolve()
