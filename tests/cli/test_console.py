"""What every command shares: three-line errors, exit codes, JSON lines."""

from __future__ import annotations

import errno
import json

import pytest
import typer
from typer.testing import CliRunner

from gw_cli.app import app as gw
from gw_cli.console import Console, command
from gw_cli.options import preset_config
from stages.shared.errors import BadData, Locked, MissingInput, StorageFailure, UsageProblem
from stages.shared.plan import Plan


def _app_that_raises(error: BaseException) -> typer.Typer:
    app = typer.Typer()

    @app.command()
    @command
    def fails() -> None:
        raise error

    return app


@pytest.mark.parametrize(
    ("error", "exit_code"),
    [
        (UsageProblem("a", "b", "c"), 2),
        (BadData("a", "b", "c"), 65),
        (MissingInput("a", "b", "c"), 66),
        (StorageFailure("a", "b", "c"), 74),
        (Locked("a", "b", "c"), 75),
        (OSError(errno.ENOSPC, "No space left on device", "x.bin"), 74),
        (PermissionError(errno.EACCES, "Permission denied", "x.bin"), 74),
        (KeyboardInterrupt(), 130),
        (ZeroDivisionError("oops"), 70),
    ],
)
def test_every_failure_has_its_exit_code(error: BaseException, exit_code: int) -> None:
    outcome = CliRunner().invoke(_app_that_raises(error), [])
    assert outcome.exit_code == exit_code
    assert "Traceback" not in outcome.output


def test_an_error_is_three_lines_what_where_fix() -> None:
    error = BadData("The mesh has no faces.", "scan.ply", "Export it again with faces.")
    outcome = CliRunner().invoke(_app_that_raises(error), [])
    lines = outcome.stderr.strip().splitlines()
    assert [line.split(":")[0].strip() for line in lines] == ["error", "where", "fix"]
    assert "no faces" in lines[0] and "scan.ply" in lines[1] and "Export" in lines[2]


@pytest.mark.parametrize(
    ("words", "says", "where"),
    [
        ("canonicalize", "Missing argument 'SUBJECT'", "gw canonicalize"),
        ("tryon a.gwg", "Missing option '--poses'", "gw tryon"),
        ("trian", "No such command 'trian'", "gw"),
        ("bench trian", "No such command 'trian'", "gw bench"),
        ("render a.gwg --camra orbit", "No such option: --camra", "gw render"),
        ("render a.gwg --fps fast", "Invalid value for '--fps'", "gw render"),
        ("render a.gwg --width 4", "Invalid value for '--width'", "gw render"),
        ("status a b", "unexpected extra argument", "gw status"),
    ],
)
def test_a_command_line_that_cannot_be_read_gets_three_lines(words: str, says: str, where: str) -> None:
    outcome = CliRunner().invoke(gw, words.split(), prog_name="gw")
    what, place, fix = outcome.stderr.splitlines()
    assert outcome.exit_code == 2 and outcome.stdout == ""
    assert what.startswith("error: ") and says in what
    assert place == f" where: {where}" and f"{where} --help" in fix


def test_a_group_without_a_command_shows_its_help() -> None:
    outcome = CliRunner().invoke(gw, ["bench"], prog_name="gw")
    assert outcome.exit_code == 2 and "tradeoff" in outcome.output and "error:" not in outcome.output


def test_a_bug_leaves_a_report_with_the_traceback() -> None:
    outcome = CliRunner().invoke(_app_that_raises(ZeroDivisionError("oops")), [])
    report = outcome.stderr.splitlines()[1].removeprefix(" where: ")
    with open(report) as file:  # noqa: PTH123 - the path is outside the test's folder
        assert "ZeroDivisionError: oops" in file.read()


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ("inspect none.gwg --json", 66, "no such bundle"),
        ("inspect none.gwg --json --nonsense", 2, "--nonsense"),
        ("train nowhere --preset huge --json", 2, "huge"),
    ],
)
def test_a_failure_with_json_is_one_object(words: str, code: int, says: str) -> None:
    outcome = CliRunner().invoke(gw, words.split(), prog_name="gw")
    (line,) = outcome.stdout.splitlines()
    error = json.loads(line)["error"]
    assert outcome.exit_code == error["exit_code"] == code
    assert says in error["what"] and error["where"] and error["fix"]


def test_json_events_end_with_the_result(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(as_json=True)
    console.step("baking")
    console.progress(3, 3, loss=0.5)
    console.result({"texels": 7})
    captured = capsys.readouterr()
    lines = [json.loads(line) for line in captured.out.splitlines()]
    assert lines[-1] == {"result": {"texels": 7}}
    assert lines[1]["done"] == 3 and lines[1]["loss"] == 0.5
    assert captured.err == ""


def test_people_read_stderr_and_stdout_stays_clean(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    console.step("baking")
    console.result({"texels": 7}, next_command="gw train out")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "texels: 7" in captured.err and "next: gw train out" in captured.err


def test_a_result_that_is_not_a_number_is_refused() -> None:
    with pytest.raises(ValueError):
        Console(as_json=True).result({"psnr": float("nan")})


def test_dry_run_prints_the_plan_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    Console(as_json=True).plan(Plan(["a"], ["b"], {"pitch": 1}, seconds=2.0))
    result = json.loads(capsys.readouterr().out)["result"]
    assert result["dry_run"] is True and result["inputs"] == ["a"] and result["seconds"] == 2.0


def test_an_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(UsageProblem) as caught:
        preset_config({"tiny": 1, "draft": 2}, "huge")
    assert "tiny, draft" in caught.value.fix
