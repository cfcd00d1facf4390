"""The command that runs cases: what it calls right and wrong."""

from __future__ import annotations

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


def test_a_case_without_an_expectation_is_skipped(tmp_path: Path) -> None:
    assert cases.judge(tmp_path / "99-unknown", 1).startswith("skipped")
