"""Writing an artifact: a hidden folder that is renamed when everything in it is on the disk."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.shared.artifacts import lock
from stages.shared.artifacts.arrays import describe_arrays, encode_arrays
from stages.shared.artifacts.artifact import Artifact
from stages.shared.artifacts.canonical import readable_json, seal, to_json
from stages.shared.artifacts.external import ExternalFiles, complete_folders, file_digest
from stages.shared.artifacts.files import (
    Chunks,
    flush_folder,
    make_folders,
    make_read_only,
    remove_folder,
    replace_folder,
    write_file,
)
from stages.shared.artifacts.leftovers import acquire_writer, backup_path, progress_path, temporary_path
from stages.shared.artifacts.manifest import (
    MANIFEST_NAME,
    RUN_NAME,
    FileEntry,
    Manifest,
    is_plain_name,
)
from stages.shared.artifacts.pictures import encode_png
from stages.shared.artifacts.resident import peak_resident_bytes
from stages.shared.artifacts.spec import StageSpec
from stages.shared.errors import BadData

if TYPE_CHECKING:
    from stages.shared.artifacts.workspace import Workspace

_last_finished = time.monotonic()
_LIBRARIES = ("numpy", "torch", "scipy", "open3d", "igl", "trimesh", "cv2", "numba", "roma", "av")


class Build:
    """Context manager that writes an artifact. On an error inside the block nothing is left.

    Attributes:
        path: the hidden folder that is being filled.
        artifact: the finished artifact, after the block.
    """

    def __init__(
        self,
        workspace: Workspace,
        spec: StageSpec,
        config: Any,
        inputs: Mapping[str, Artifact | ExternalFiles],
        force: bool = False,
    ) -> None:
        self._workspace = workspace
        self._inputs = inputs
        self._force = force
        self._manifest = Manifest(spec.name, spec.schema, spec.code_version, to_json(config))
        self._measured: dict[str, Any] = {}
        self._records: dict[str, FileEntry] = {}
        self.path = temporary_path(workspace.root, spec.name)
        self.artifact: Artifact

    @property
    def key(self) -> str:
        """Name the finished folder will have; known inside the block."""
        return self._manifest.key

    def write_arrays(
        self, name: str, arrays: Mapping[str, Any], about: Mapping[str, str] | None = None
    ) -> None:
        """Write arrays as safetensors.

        Arguments:
            name: file name; ".safetensors" is added when it is missing.
            arrays: name to array; NumPy or anything it takes.
            about: name to a short text: unit, frame, axes, e.g. "m canonical (V,3)".

        Raises:
            BadData: a value is not finite, or its type cannot be stored.
            StorageFailure: disk full.
        """
        name = name if name.endswith(".safetensors") else name + ".safetensors"
        arrays = {key: np.asarray(value) for key, value in arrays.items()}
        described = describe_arrays(arrays, about or {})
        self._write(name, encode_arrays(arrays, f"{self._manifest.stage}/{name}"))
        self._manifest.arrays[name] = described

    def write_json(self, name: str, value: Any) -> None:
        """Write JSON with sorted names; dataclasses and NumPy values are taken as plain ones."""
        name = name if name.endswith(".json") else name + ".json"
        self._write(name, readable_json(value))

    def write_bytes(self, name: str, data: Chunks) -> None:
        """Write a file as it is."""
        self._write(name, data)

    def write_picture(self, name: str, picture: np.ndarray) -> None:
        """Write a picture (H, W), (H, W, 3) or (H, W, 4) uint8 sRGB as PNG."""
        self._write(name, encode_png(picture))

    def write_record(self, name: str, data: Chunks) -> None:
        """Write a file about this run (a log with times, previews made by the clock).

        It is kept and verified like the others, but it is not part of what names the artifact: two runs with
        the same result have the same digest.
        """
        self._records[name] = self._put(name, data)

    def summary(self, **numbers: Any) -> None:
        """A few numbers to judge the artifact by. They are part of its content: no times, no machine."""
        self._manifest.summary.update(to_json(numbers))

    def measured(self, **numbers: Any) -> None:
        """Numbers about this run that differ between runs (times, memory); kept apart from the content."""
        self._measured.update(to_json(numbers))

    def __enter__(self) -> Build:
        acquire_writer(self._workspace.root)
        try:
            make_folders(self.path)
            self._started = time.monotonic()
            self._started_at = datetime.now(UTC).isoformat(timespec="seconds")
            entries, listings = self._workspace.register_inputs(self._inputs)
            self._manifest.inputs.update(entries)
            for name, listing in listings.items():
                self._write(name, readable_json(listing))
            self._complete = {
                name: complete_folders(source.listed(), source.root)
                for name, source in self._inputs.items()
                if isinstance(source, ExternalFiles)
            }
        except BaseException:
            self._abandon()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self._abandon()
            return
        try:
            self._commit()
        except BaseException:
            self._abandon()
            raise
        lock.release(self._workspace.root)

    def _commit(self) -> None:
        """Manifest last, flush, rename, flush the parent, point `current.json` at it."""
        self._refuse_strays()
        write_file(self.path / RUN_NAME, seal(self._run()))
        write_file(self.path / MANIFEST_NAME, self._manifest.to_bytes())
        make_read_only(self.path)
        for folder in sorted((path for path in self.path.rglob("*") if path.is_dir()), reverse=True):
            flush_folder(folder)
        flush_folder(self.path)
        root, stage, key = self._workspace.root, self._manifest.stage, self._manifest.key
        final = root / stage / key
        make_folders(final.parent)
        if not self._force and self._is_there(final):
            remove_folder(self.path)
        else:
            replace_folder(self.path, final, backup_path(root, stage, key))
        self.artifact = Artifact(final)
        self._workspace.set_current(self.artifact)
        remove_folder(progress_path(root, stage, key))

    def _is_there(self, final: Path) -> bool:
        """Whether the same content already stands, whole, under the final name."""
        if not final.exists():
            return False
        try:
            standing = Artifact(final)
            for name in standing.files:
                standing.file(name)
            return standing.digest == self._manifest.digest
        except BadData:
            return False

    def _refuse_strays(self) -> None:
        names = {path.relative_to(self.path).as_posix() for path in self.path.rglob("*") if not path.is_dir()}
        strays = sorted(names - set(self._manifest.files) - set(self._records))
        if strays:
            raise ValueError(f"{self._manifest.stage}: {strays[0]} was not written through the build")

    def _write(self, name: str, data: Chunks) -> None:
        self._manifest.files[name] = self._put(name, data)

    def _put(self, name: str, data: Chunks) -> FileEntry:
        """Write a file into the hidden folder; its size and digest."""
        taken = {MANIFEST_NAME, RUN_NAME, *self._manifest.files, *self._records}
        if not is_plain_name(name) or name in taken:
            raise ValueError(f"{name!r} cannot be the name of a file of an artifact, or is one already")
        path = self.path / name
        make_folders(path.parent)
        write_file(path, data)
        return FileEntry(path.stat().st_size, file_digest(path))

    def _run(self) -> dict[str, Any]:
        return {
            "started": self._started_at,
            "seconds": round(time.monotonic() - self._started, 3),
            "stage_seconds": round(_since_last_artifact(), 3),
            "complete_folders": self._complete,
            "peak_bytes": peak_resident_bytes(),
            "python": platform.python_version(),
            "system": f"{platform.system()} {platform.machine()}",
            "libraries": _library_versions(),
            "records": to_json(self._records),
            **self._measured,
        }

    def _abandon(self) -> None:
        try:
            remove_folder(self.path)
        finally:
            lock.release(self._workspace.root)


def _since_last_artifact() -> float:
    """Seconds since this process finished its last artifact, or loaded the store: the cost of a stage."""
    global _last_finished
    before, _last_finished = _last_finished, time.monotonic()
    return _last_finished - before


def _library_versions() -> dict[str, str]:
    """Versions of the numerical libraries that this process has loaded."""
    loaded = {
        name: getattr(sys.modules[name], "__version__", None) for name in _LIBRARIES if name in sys.modules
    }
    return {name: str(version) for name, version in loaded.items() if version is not None}
