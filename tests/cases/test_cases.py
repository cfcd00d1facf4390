"""The command that runs cases: what it calls right and wrong."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.cases import __main__ as cases


@pytest.mark.parametrize(
    ("command", "verdict"),
    [
        ("echo 4200000 frames", "right"),
        ("echo nothing", "wrong: lacks"),
        ("echo 4200000 frames; echo A bug in gw", "wrong: A bug in gw"),
        ("echo 4200000 frames; sleep 60", "wrong: not finished"),
    ],
)
def test_answers_are_judged(command: str, verdict: str, tmp_path: Path) -> None:
    case = tmp_path / "adversarial" / "10-npz-bomb"
    case.mkdir(parents=True)
    (case / "cmd.sh").write_text(command)
    assert cases.judge(case, 1).startswith(verdict)


def test_a_case_without_an_expectation_must_not_report_a_bug(tmp_path: Path) -> None:
    case = tmp_path / "bundles" / "99-unknown"
    case.mkdir(parents=True)
    (case / "cmd.sh").write_text("echo fine")
    assert cases.judge(case, 5).startswith("right: no bug reported")
    (case / "cmd.sh").write_text("echo A bug in gw")
    assert cases.judge(case, 5).startswith("wrong")


def test_jobs_in_the_background_can_be_interrupted_and_do_not_outlive_their_case(tmp_path: Path) -> None:
    case = tmp_path / "adversarial" / "98-jobs"
    case.mkdir(parents=True)
    left = tmp_path / "left.txt"
    (case / "cmd.sh").write_text(
        f"sleep 60 & kill -INT %1; wait %1; echo $?; sleep 71 & echo $! > {left}; sleep 60"
    )
    assert cases.judge(case, 1).startswith("wrong: not finished")
    assert not Path(f"/proc/{left.read_text().strip()}/cmdline").is_file() or not Path(
        f"/proc/{left.read_text().strip()}/cmdline"
    ).read_bytes().startswith(b"sleep")


@pytest.mark.skipif("DEMO" in os.environ, reason="a demo is there")
def test_a_case_that_needs_a_demo_is_skipped_without_one(tmp_path: Path) -> None:
    case = tmp_path / "adversarial" / "97-demo"
    case.mkdir(parents=True)
    (case / "cmd.sh").write_text('ls "$DEMO"')
    assert cases.judge(case, 1) == "skipped: DEMO is not set"
