"""One flipped bit anywhere is found, and no stage reads past it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.shared.artifacts import Artifact, Workspace
from stages.shared.artifacts.verify import verify
from stages.shared.errors import BadData, MissingInput
from tests.shared.artifacts.conftest import FIRST, make_first, make_second


@pytest.fixture
def finished(workspace: Workspace, capture: Path) -> Workspace:
    make_second(workspace, capture, make_first(workspace, capture))
    return workspace


def read_everything(folder: Path) -> None:
    """What the next stage does: open, and read every file in one of the three ways."""
    artifact = Artifact(folder)
    for name in artifact.files:
        if name.endswith(".safetensors"):
            artifact.arrays(name)
        elif name.endswith(".json"):
            artifact.json(name)
        else:
            artifact.file(name)


def test_a_whole_workspace_verifies(finished: Workspace) -> None:
    found = verify(finished)
    assert found.damaged == [] and found.artifacts == 2 and found.files == 5 + 1 + 1 + 4
    assert found.bytes > 1000


def flip_bits(workspace: Workspace, flips: int) -> None:
    random = np.random.default_rng(5)
    files = sorted(path for path in workspace.root.glob("*/*/**/*") if path.is_file())
    files += sorted(workspace.root.glob("*/current.json"))
    assert len(files) == 13
    good = {path: path.read_bytes() for path in files}
    for path in files:
        path.chmod(0o644)
    for turn in range(flips):
        path = files[turn % len(files)]
        data = bytearray(good[path])
        position = int(random.integers(len(data) * 8))
        data[position // 8] ^= 1 << position % 8
        path.write_bytes(data)
        found = verify(workspace).damaged
        assert [damage.path for damage in found] == [path], (path, position)
        if path.name not in ("run.json", "current.json"):
            folder = workspace.root / Path(*path.relative_to(workspace.root).parts[:2])
            with pytest.raises(BadData) as caught:
                read_everything(folder)
            assert caught.value.where.startswith(str(path))
        path.write_bytes(good[path])
    assert verify(workspace).damaged == []


def test_every_flipped_bit_is_found(finished: Workspace) -> None:
    flip_bits(finished, 500)


@pytest.mark.long
def test_ten_thousand_flipped_bits_are_found(finished: Workspace) -> None:
    flip_bits(finished, 10_000)


def test_missing_added_and_shortened_files_are_found(finished: Workspace) -> None:
    folder = next(path for path in finished.artifacts() if path.parent.name == "first")
    film = folder / "previews" / "film.mp4"
    (folder / "previews" / "added.txt").write_text("more")
    assert [damage.path.name for damage in verify(finished).damaged] == ["added.txt"]
    (folder / "previews" / "added.txt").unlink()
    film.chmod(0o644)
    film.write_bytes(b"fil")
    assert [damage.path for damage in verify(finished).damaged] == [film]
    film.unlink()
    assert [damage.path for damage in verify(finished).damaged] == [film]


def test_an_artifact_under_another_name_is_found(finished: Workspace) -> None:
    folder = finished.artifacts()[0]
    folder.rename(folder.with_name("0" * 32))
    assert {damage.path.name for damage in verify(finished).damaged} == {"manifest.json", "current.json"}


def test_broken_settings_are_found(finished: Workspace) -> None:
    (finished.root / "subject.json").write_text("{")
    assert [damage.path.name for damage in verify(finished).damaged] == ["subject.json"]


def test_what_is_no_subject_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match="no such folder"):
        verify(Workspace(tmp_path / "nowhere"))
    with pytest.raises(MissingInput, match="not a subject"):
        verify(Workspace(tmp_path))


def test_a_file_in_the_place_of_a_subject_is_called_a_file(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(MissingInput, match="no kind that can be verified"):
        verify(Workspace(tmp_path / "notes.txt"))
    with pytest.raises(BadData, match="file, not a subject"):
        Workspace(tmp_path / "notes.txt").require(FIRST)


def test_records_of_a_run_are_verified_but_do_not_name_the_artifact(tmp_path: Path) -> None:
    digests = set()
    for name, texts in {
        "a": {"log.txt": b"1 s"},
        "b": {"log.txt": b"9 s", "pictures/9.png": b"x"},
        "c": {},
    }.items():
        workspace = Workspace(tmp_path / name)
        with workspace.build(FIRST, {}, {}) as build:
            build.write_json("result.json", {"value": 3})
            for file, content in texts.items():
                build.write_record(file, content)
        artifact = workspace.require(FIRST)
        assert {file: artifact.record(file) for file in artifact.records} == texts
        assert verify(workspace).damaged == []
        digests.add((artifact.digest, (artifact.path / "manifest.json").read_bytes()))
    assert len(digests) == 1
    record = Workspace(tmp_path / "b").require(FIRST).path / "log.txt"
    record.chmod(0o644)
    record.write_bytes(b"8 s")
    assert [damage.path for damage in verify(Workspace(tmp_path / "b")).damaged] == [record]
    record.unlink()
    assert [damage.path for damage in verify(Workspace(tmp_path / "b")).damaged] == [record]
