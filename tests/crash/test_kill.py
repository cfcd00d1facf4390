"""SIGKILL at any moment loses at most the work since the last checkpoint; half an artifact is never left."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stages.shared.artifacts import Workspace
from stages.shared.artifacts.files import using_layer
from stages.shared.artifacts.verify import verify
from tests.crash.fake_stage import STEPS, STEPS_PER_CHECKPOINT, CountingLayer, run

REPOSITORY = Path(__file__).resolve().parents[2]
Undisturbed = tuple[tuple[str, str], list[str]]


def start(subject: Path, capture: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "tests.crash.fake_stage", str(subject), str(capture), *options]
    return subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, start_new_session=True)


def assert_nothing_half(subject: Path) -> None:
    """Whatever has a final name is whole; what `current.json` points at is there."""
    if subject.is_dir() and Workspace(subject).artifacts():
        assert verify(Workspace(subject)).damaged == []


def assert_rerun_agrees(subject: Path, capture: Path, expected: tuple[str, str]) -> int:
    """Run to the end; the steps that had to be computed."""
    with using_layer(CountingLayer()):
        prepared, learnt, steps = run(subject, capture)
    assert (prepared, learnt) == expected
    assert verify(Workspace(subject)).damaged == []
    assert {path.name for path in subject.glob(".*")} <= {".lock", ".digests.json"}
    assert {path.name for path in subject.iterdir() if path.is_dir()} == {"prepare", "learn"}
    assert [
        len([p for p in (subject / stage).iterdir() if p.is_dir()]) for stage in ("prepare", "learn")
    ] == [1, 1]
    assert (subject / "overlay.png").read_bytes()[:4] == b"\x89PNG"
    return steps


def kill_at(subject: Path, capture: Path, at: int, moment: str, *options: str) -> None:
    process = start(subject, capture, "--kill-at", str(at), "--moment", moment, *options)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL, (at, moment)
    assert_nothing_half(subject)


def aimed_moments(calls: list[str], wanted: int) -> list[tuple[int, str]]:
    """Calls of every kind, spread over the run, each with one of the moments around it.

    Around a rename both sides count; the one that finishes an artifact is where it matters most.
    """
    around: dict[str, list[tuple[int, str]]] = {}
    for at, kind in enumerate(calls):
        moments = ("before", "inside", "after") if kind == "write" else ("before", "after")
        around.setdefault(kind, []).extend((at, moment) for moment in moments)
    chosen = around.pop("rename")
    stride = sum(len(places) for places in around.values()) // (wanted - len(chosen))
    stride = max(1, stride - (stride + 1) % 2)  # odd, or it would meet the same moment of every call
    return chosen + [place for places in around.values() for place in places[::stride]]


def aimed_kills(undisturbed: Undisturbed, capture: Path, folder: Path, wanted: int) -> None:
    expected, calls = undisturbed
    chosen = aimed_moments(calls, wanted)
    assert {calls[at] for at, _ in chosen} == set(calls) and len(chosen) >= wanted
    for number, (at, moment) in enumerate(chosen):
        subject = folder / str(number)
        kill_at(subject, capture, at, moment)
        checkpoints_done = sum(
            path.is_file() for path in subject.glob(".learn.progress-*/checkpoint.safetensors")
        )
        steps = assert_rerun_agrees(subject, capture, expected)
        assert steps <= STEPS - STEPS_PER_CHECKPOINT * checkpoints_done


def random_kills(undisturbed: Undisturbed, capture: Path, folder: Path, kills: int) -> None:
    """The same subject is killed again and again at random times, each time going on from where it was."""
    expected, _ = undisturbed
    chance = random.Random(7)
    killed = 0
    subject = folder / "0"
    for number in range(20 * kills):
        process = start(subject, capture)
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        time.sleep(chance.uniform(0, 0.25))
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            killed += 1
        process.communicate(timeout=60)
        assert_nothing_half(subject)
        if process.returncode == 0 or number % 4 == 3:
            assert_rerun_agrees(subject, capture, expected)
            subject = folder / str(number + 1)
        if killed == kills:
            return
    raise AssertionError(f"only {killed} of {kills} processes were still running when they were to be killed")


def test_kills_at_aimed_moments(undisturbed: Undisturbed, crash_capture: Path, tmp_path: Path) -> None:
    aimed_kills(undisturbed, crash_capture, tmp_path, 40)


def test_kills_at_random_moments(undisturbed: Undisturbed, crash_capture: Path, tmp_path: Path) -> None:
    random_kills(undisturbed, crash_capture, tmp_path, 12)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_four_hundred_kills(undisturbed: Undisturbed, crash_capture: Path, tmp_path: Path) -> None:
    aimed_kills(undisturbed, crash_capture, tmp_path / "aimed", 200)
    random_kills(undisturbed, crash_capture, tmp_path / "random", 200)


def test_kills_while_an_artifact_is_replaced_lose_nothing(
    undisturbed: Undisturbed, crash_capture: Path, tmp_path: Path
) -> None:
    """With --force the finished artifact steps aside for its successor: one of both is always there."""
    expected, _ = undisturbed
    subject = tmp_path / "subject"
    run(subject, crash_capture)
    with using_layer(CountingLayer()) as layer:
        run(subject, crash_capture, force=True)
    assert isinstance(layer, CountingLayer)
    renames = [at for at, kind in enumerate(layer.calls) if kind == "rename"]
    for turn, at in enumerate(renames):
        process = start(subject, crash_capture, "--kill-at", str(at), "--moment", "after", "--force")
        process.communicate(timeout=60)
        assert process.returncode == -signal.SIGKILL
        Workspace(subject).save_settings(turn=turn)  # the next run that holds the lock tidies up
        assert_nothing_half(subject)
        assert len(Workspace(subject).artifacts()) == 2
        assert run(subject, crash_capture) == (*expected, 0)


def test_the_lock_of_a_dead_process_is_free_at_once(
    crash_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = tmp_path / "subject"
    process = start(subject, crash_capture, "--hold", "60")
    assert process.stdout is not None
    assert [process.stdout.readline(), process.stdout.readline()] == [b"ready\n", b"holding\n"]
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=10)
    with monkeypatch.context() as patched:
        patched.setattr(time, "sleep", lambda seconds: pytest.fail("a writer waited for a dead process"))
        Workspace(subject).save_settings(capture=crash_capture)
    assert [path.name for path in subject.glob(".*")] == [".lock"]
