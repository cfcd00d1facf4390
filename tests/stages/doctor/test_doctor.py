"""`gw doctor`: finds what is there, survives what crashes, and says what it means."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.doctor import stage
from stages.doctor.libraries import CORE, Check, try_program, versions
from stages.doctor.machine import Machine, look
from stages.doctor.stage import judge

GOOD = Machine("Linux", "a processor", 2, ("avx2", "fma"), 8 << 30, 6 << 30, 50 << 30, True, {})
ALL = dict.fromkeys(CORE, "1")


def test_this_machine(tmp_path: Path) -> None:
    machine = look(tmp_path / "not" / "there" / "yet")
    assert machine.cores == len(os.sched_getaffinity(0))
    assert machine.memory_bytes >= machine.free_memory_bytes > 100 << 20
    assert machine.free_disk_bytes > 0 and machine.writable


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("import os; os.kill(os.getpid(), 11)", "signal 11"),
        ("import time; time.sleep(60)", "no answer"),
        ("import no_such_module", "no_such_module"),
        ("import sys; sys.exit('the library says no')", "the library says no"),
        ("from stages.shared.errors import BadData\nraise BadData('No', 'x', 'Do y.')", "No (x). Do y."),
    ],
)
def test_a_library_that_crashes_hangs_or_is_not_there_is_a_line(program: str, said: str) -> None:
    found = try_program("it", program, seconds=3)
    assert not found.works and said in found.said and "stages." not in found.said


def test_a_library_that_works() -> None:
    assert try_program("it", "import math") == Check("it", True)


def test_versions() -> None:
    found = versions(("numpy", "no-such-package"))
    assert found["numpy"] and found["no-such-package"] is None


@pytest.mark.parametrize(
    ("machine", "failed", "says"),
    [
        ({"cores": 1}, None, "One core"),
        ({"instructions": ("sse4_2",)}, None, "AVX2"),
        ({"free_memory_bytes": 1 << 30}, None, "memory"),
        ({"free_disk_bytes": 1 << 20}, None, "disk"),
        ({"thread_limits": {"OMP_NUM_THREADS": "1"}}, None, "OMP_NUM_THREADS"),
        ({}, "cuda", "paper does not"),
        ({}, "pymeshlab", "libigl"),
    ],
)
def test_what_will_be_slow(machine: dict[str, object], failed: str | None, says: str) -> None:
    checks = [Check(failed, False, "no")] if failed else []
    slow, broken = judge(replace(GOOD, **machine), checks, ALL)  # type: ignore[arg-type]
    assert len(slow) == 1 and says in slow[0] and not broken


def test_a_good_machine_has_nothing_to_say() -> None:
    assert judge(GOOD, [], ALL) == ([], [])


def test_what_is_broken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(stage, "try_all", lambda: [Check("open3d", False, "ended by signal 11")])
    done = CliRunner().invoke(app, ["doctor", str(tmp_path)])
    assert (
        done.exit_code == 66
        and "open3d does not work here: ended by signal 11. Install it again." in done.stderr
    )


def test_the_command(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["doctor", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])["result"]
    assert {check["name"] for check in found["checks"]} == {"torch", "open3d", "pymeshlab", "video", "cuda"}
    assert all(check["works"] for check in found["checks"] if check["name"] in ("torch", "open3d"))
    assert found["libraries"]["torch"] and found["broken"] == []
