"""Two processes on one subject: one writes, the other is told at once by whom."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from stages.shared.artifacts import Workspace
from stages.shared.artifacts.verify import verify
from stages.shared.errors import Locked
from tests.crash.fake_stage import PREPARE, Config, run
from tests.crash.test_kill import REPOSITORY, Undisturbed


def hold(subject: Path, capture: Path, seconds: float, *options: str) -> subprocess.Popen[str]:
    words = [str(subject), str(capture), "--hold", str(seconds), *options]
    command = [sys.executable, "-m", "tests.crash.fake_stage", *words]
    return subprocess.Popen(
        command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def races(capture: Path, subject: Path, rounds: int) -> None:
    """Two processes that are let go at the same moment; the winner stays until the other has been told."""
    for turn in range(rounds):
        gate = subject.parent / f"gate{turn}"
        gate.mkdir()
        racers = [hold(subject, capture, 60, "--gate", str(gate)) for _ in range(2)]
        for racer in racers:
            assert racer.stdout is not None and racer.stdout.readline() == "ready\n"
        (gate / "begin").touch()
        end = time.monotonic() + 30
        while all(racer.poll() is None for racer in racers) and time.monotonic() < end:
            time.sleep(0.005)
        (gate / "end").touch()
        outcomes = [racer.communicate(timeout=30) for racer in racers]
        codes = sorted(racer.returncode for racer in racers)
        assert codes == [0, 75], outcomes
        loser = next(number for number, racer in enumerate(racers) if racer.returncode == 75)
        message = outcomes[loser][1]
        assert re.search(
            rf"Process {racers[1 - loser].pid} on host {re.escape(socket.gethostname())} ", message
        )
        assert "holding" not in outcomes[loser][0]
        assert verify(Workspace(subject)).damaged == []
        assert [path.name for path in subject.glob(".*")] == [".lock"]


def test_one_of_two_writers_wins(crash_capture: Path, tmp_path: Path) -> None:
    races(crash_capture, tmp_path / "subject", 6)


@pytest.mark.long
def test_fifty_races(crash_capture: Path, tmp_path: Path) -> None:
    races(crash_capture, tmp_path / "subject", 50)


def test_the_loser_is_refused_without_waiting_and_readers_go_on(
    undisturbed: Undisturbed, crash_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = tmp_path / "subject"
    assert run(subject, crash_capture)[:2] == undisturbed[0]
    holder = hold(subject, crash_capture, 2)
    try:
        assert holder.stdout is not None
        assert [holder.stdout.readline(), holder.stdout.readline()] == ["ready\n", "holding\n"]
        owner = f"Process {holder.pid} on host {socket.gethostname()}"
        with monkeypatch.context() as patched, pytest.raises(Locked, match=owner) as caught:
            patched.setattr(time, "sleep", lambda seconds: pytest.fail("a refused writer waited"))
            Workspace(subject).save_settings(more=1)
        assert caught.value.exit_code == 75 and caught.value.where == str(subject / ".lock")
        assert run(subject, crash_capture)[:2] == undisturbed[0]
        assert verify(Workspace(subject)).damaged == []
    finally:
        assert holder.wait(timeout=30) == 0


def test_threads_of_one_process_are_kept_apart(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "subject")
    seen: list[BaseException] = []

    def other() -> None:
        try:
            workspace.save_settings(a=1)
        except Locked as error:
            seen.append(error)

    with workspace.build(PREPARE, Config(), {}) as build:
        workspace.save_settings(b=1)  # the same thread goes on
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        build.write_json("x", 1)
    assert len(seen) == 1 and workspace.settings() == {"b": 1}
    other()
    assert len(seen) == 1 and workspace.settings() == {"a": 1, "b": 1}
