"""Renders in several runs: shards, a kill in the middle, and memory that does not grow."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest

from stages.render import stage
from stages.shared.errors import UsageProblem
from stages.shared.render_sequence.config import RenderConfig
from tests.listening import Listener
from tests.shared.outfit.wardrobe import motion

SMALL = RenderConfig(width=48, height=64, passes=("labels", "depth", "layers"), exports=("ply",))


def contents(folder: Path) -> dict[str, bytes]:
    """All files but result.json, which holds times."""
    found = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    assert "result.json" in found
    return {name: path.read_bytes() for name, path in sorted(found.items()) if name != "result.json"}


@pytest.fixture(scope="module")
def dressed(wardrobe: Path) -> list[Path]:
    return [wardrobe / f"{name}.gwg" for name in ("body", "lower", "upper")]


@pytest.fixture(scope="module")
def whole(dressed: list[Path], wardrobe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    stage.run(dressed, wardrobe / "motion.npz", None, out, SMALL)
    return out


def test_shards_merge_to_the_same_bytes(
    dressed: list[Path], wardrobe: Path, whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    for index in (2, 1, 3):
        part = stage.run(dressed, wardrobe / "motion.npz", None, out, replace(SMALL, shard=f"{index}/3"))
        assert not part.complete and not out.exists()
        assert part.summary["frames"] == (1 if index == 3 else 2)
    report = Listener()
    merged = stage.run(dressed, wardrobe / "motion.npz", None, out, SMALL, report)
    assert merged.complete and merged.summary["kept_frames"] == 5 and not report.progressed
    assert merged.summary["pictures"] == 5
    found = contents(out)
    assert found == contents(whole) and {"film.mp4", "ply/frame000004.ply"} <= set(found)
    assert list(tmp_path.iterdir()) == [out]


def test_an_interrupted_run_goes_on(dressed: list[Path], wardrobe: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        stage.run(dressed, wardrobe / "motion.npz", None, out, SMALL, Listener(stop=2))
    assert not out.exists()
    (part,) = tmp_path.glob(".out.part-*")
    finished = (part / "frames/000001.png").stat().st_mtime_ns
    half = part / "frames/000004.png"  # the last of five; frames at work when Ctrl-C came were finished
    half.write_bytes(b"half a picture")  # as a kill leaves it: no record says that it is whole
    other = replace(SMALL, frames="0:2")
    stage.run(dressed, wardrobe / "motion.npz", None, tmp_path / "else", other)
    report = Listener()
    result = stage.run(dressed, wardrobe / "motion.npz", None, out, SMALL, report)
    kept = result.summary["kept_frames"]
    assert 2 <= kept <= 4 and len(report.progressed) == 5 - kept
    assert (out / "frames/000001.png").stat().st_mtime_ns == finished
    assert contents(out) == contents(whole)


def test_another_configuration_starts_anew(dressed: list[Path], wardrobe: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        stage.run(dressed, wardrobe / "motion.npz", None, out, SMALL, Listener(stop=2))
    wider = replace(SMALL, width=64)
    assert stage.run(dressed, wardrobe / "motion.npz", None, out, wider).summary["kept_frames"] == 0
    assert list(tmp_path.iterdir()) == [out]  # what nobody goes on with is gone
    again = stage.run(dressed, wardrobe / "motion.npz", None, out, wider)
    assert again.summary["kept_frames"] == 0  # a finished folder is made anew


def test_a_killed_process_goes_on(dressed: list[Path], wardrobe: Path, whole: Path, tmp_path: Path) -> None:
    """SIGKILL while frames are being written; the next process finishes the same bytes."""
    out = tmp_path / "out"
    words = [sys.executable, "-m", "gw_cli", "render", *map(str, dressed), "-o", str(out)]
    words += ["--poses", str(wardrobe / "motion.npz"), "--width", "48", "--height", "64", "--json"]
    words += ["--passes", "labels,depth,layers", "--export", "ply"]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        if list(tmp_path.glob(".out.part-*/records/000000.json")):
            os.kill(process.pid, signal.SIGKILL)
            break
        time.sleep(0.002)
    process.wait(60)
    result = stage.run(dressed, wardrobe / "motion.npz", None, out, SMALL)
    assert contents(out) == contents(whole)
    assert result.summary["kept_frames"] >= 1 or process.returncode == 0


def test_memory_does_not_grow_with_the_frames(dressed: list[Path], tmp_path: Path) -> None:
    peaks = []
    for count in (4, 4, 20):  # the first one warms up
        (tmp_path / "motion.npz").write_bytes(motion(count).to_npz_bytes())
        config = RenderConfig(width=160, height=160, penetration=False)
        tracemalloc.start()
        stage.run(dressed[:1], tmp_path / "motion.npz", None, tmp_path / f"out{count}{len(peaks)}", config)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < peaks[1] + 500_000  # 16 more frames are 1.6 MB as bytes


def test_strange_shares(dressed: list[Path], wardrobe: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageProblem, match="part of the work"):
        stage.run(dressed, wardrobe / "motion.npz", None, tmp_path / "out", RenderConfig(shard="4/3"))
