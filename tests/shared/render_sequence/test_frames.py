"""Sequences rendered on several cores: the same files, in order; an interrupt leaves whole frames."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from stages.shared.errors import StorageFailure
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.pictures.parts import RECORDS, Share
from stages.shared.render_sequence import frames as sequence_frames
from stages.shared.render_sequence.frames import assemble, write_frames
from stages.shared.render_sequence.outputs import SequenceFrame, SequenceOutputs
from tests.shared.outfit.wardrobe import bundle, cameras, motion, worn

OUTFIT = outfit_of_bundles([(name, bundle(worn(name, source=name))) for name in ("body", "upper")])
POSES = motion(9)
FRAMES = [SequenceFrame(row, (cameras()[0],)) for row in range(9)]
CONFIG = SequenceOutputs(passes=("labels", "depth", "layers"), exports=("ply",))


class Heard:
    """Remembers progress, and stops the run after so many frames."""

    def __init__(self, stop: int = 99) -> None:
        self.seen: list[tuple[int, int]] = []
        self.stop = stop

    def step(self, text: str) -> None: ...

    def say(self, text: str) -> None: ...

    def warn(self, text: str) -> None: ...

    def progress(self, done: int, total: int, **numbers: float) -> None:
        self.seen.append((done, total))
        if done == self.stop:
            raise KeyboardInterrupt


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
        assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)


def _files(folder: Path) -> dict[str, bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and RECORDS not in path.parts)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """One frame after the other."""
    folder = tmp_path_factory.mktemp("alone")
    with _threads(1):
        assert write_frames(folder, OUTFIT, POSES, FRAMES, CONFIG, Heard()) == 0
    found = _files(folder)
    assert len(found) == 9 * 6 and len(set(found.values())) > 9 * 4
    return found


@pytest.mark.parametrize("count", [2, 3])
def test_same_files_whatever_the_threads(count: int, alone: dict[str, bytes], tmp_path: Path) -> None:
    heard = Heard()
    with _threads(count):
        write_frames(tmp_path, OUTFIT, POSES, FRAMES, CONFIG, heard)
    assert _files(tmp_path) == alone
    assert heard.seen == [(done, 9) for done in range(1, 10)]
    summary = assemble(tmp_path, OUTFIT, POSES, FRAMES, CONFIG)
    assert summary.pictures == 9 and summary.wall == pytest.approx(summary.rendering / count)


def test_an_interrupt_leaves_whole_frames_and_the_rest_is_made_later(
    alone: dict[str, bytes], tmp_path: Path
) -> None:
    before = threading.active_count()
    with _threads(2), pytest.raises(KeyboardInterrupt):
        write_frames(tmp_path, OUTFIT, POSES, FRAMES, CONFIG, Heard(stop=3))
    assert threading.active_count() == before, "nobody writes any more"
    records = sorted((tmp_path / RECORDS).glob("*.json"))
    assert 3 <= len(records) <= 6
    assert all(json.loads(path.read_bytes())["pictures"] == 1 for path in records)
    for path in records:
        for name in (f"frames/{path.stem}.png", f"ply/frame{path.stem}.ply"):
            assert (tmp_path / name).read_bytes() == alone[name]
    with _threads(2):
        assert write_frames(tmp_path, OUTFIT, POSES, FRAMES, CONFIG, Heard()) == len(records)
    assert _files(tmp_path) == alone


def test_shards_give_the_same_files(alone: dict[str, bytes], tmp_path: Path) -> None:
    with _threads(2):
        for index in (2, 1):
            assert write_frames(tmp_path, OUTFIT, POSES, FRAMES, CONFIG, Heard(), Share(index, 2)) == 0
        assert write_frames(tmp_path, OUTFIT, POSES, FRAMES, CONFIG, Heard()) == 9
    assert _files(tmp_path) == alone


def test_a_full_disk_reaches_the_caller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    genuine = sequence_frames._write_frame

    def full(
        folder: Path, player: CachedPoser, poses: object, frame: SequenceFrame, config: SequenceOutputs
    ) -> object:
        if frame.row == 4:
            raise StorageFailure("The disk is full.", "here", "Free some.")
        return genuine(folder, player, poses, frame, config)  # type: ignore[arg-type]

    monkeypatch.setattr(sequence_frames, "_write_frame", full)
    with _threads(2), pytest.raises(StorageFailure):
        write_frames(tmp_path, OUTFIT, POSES, FRAMES, CONFIG, Heard())
    names = {path.name for path in (tmp_path / RECORDS).glob("*.json")}
    assert "000004.json" not in names and "000003.json" in names and len(names) < 9
