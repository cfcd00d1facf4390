"""Standard streams that are closed, broken or ASCII only; text from files; signals; and the last handler."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from gw_cli import failures
from gw_cli.console import Console, command
from gw_cli.streams import shown
from stages.shared import memory
from stages.shared.errors import BadData, UsageProblem

REPOSITORY = Path(__file__).resolve().parents[2]
GW = f"{sys.executable} -m gw_cli"
BUNDLE = REPOSITORY / "tests/golden/body-1.1.gwg"


def shell(line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The outcome of a line for bash, with `gw` in it."""
    return subprocess.run(
        ["bash", "-c", line.replace("gw ", f"{GW} ")],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=60,
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), **environment},
    )


@pytest.mark.parametrize(
    ("line", "codes"),
    [
        ("gw inspect BUNDLE --json >&-", (0, 74)),
        ("gw inspect BUNDLE 2>&-", (0,)),
        ("gw inspect BUNDLE --json >&- 2>&- <&-", (0, 74)),
        ("gw inspect NONE.gwg 2>&-", (66,)),
        ("gw inspect BUNDLE --json >/dev/full", (74,)),
        ("gw inspect NONE.gwg 2>/dev/full", (66,)),
        ("gw --help >/dev/full", (74,)),
        ("gw inspect BUNDLE --json | sleep 0; exit ${PIPESTATUS[0]}", (0, 74)),
        ("gw wardrobe list tests/golden 2>&1 | sleep 0; exit ${PIPESTATUS[0]}", (0,)),
    ],
)
def test_a_stream_that_is_closed_or_full_leaves_no_traceback(line: str, codes: tuple[int, ...]) -> None:
    outcome = shell(line.replace("BUNDLE", str(BUNDLE)))
    assert outcome.returncode in codes, outcome.stderr
    assert "Traceback" not in outcome.stderr and "Exception ignored" not in outcome.stderr


@pytest.mark.parametrize(
    "words", ["tryon --help", "--help", "wardrobe --help", "inspect é…×.gwg", "verify ü"]
)
def test_a_terminal_that_knows_ascii_only(words: str) -> None:
    outcome = shell(f"gw {words}", PYTHONIOENCODING="ascii", TERM="dumb")
    assert outcome.returncode in (0, 66) and "Traceback" not in outcome.stderr
    assert (outcome.stdout + outcome.stderr).isascii()


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("plain ünïcode 漢字", "plain ünïcode 漢字"),
        ("a\x1b[31mRED", "a\\x1b[31mRED"),
        ("one\ntwo\rthree\tfour", "one\\x0atwo\\x0dthree\\x09four"),
        ("c1\x9b2J", "c1\\x9b2J"),
        ("bidi\u202egnp.exe\u2066", "bidi\\u202egnp.exe\\u2066"),
        ("line\u2028next\u2029", "line\\u2028next\\u2029"),
        ("zero\u200bwidth\ufeff", "zero\\u200bwidth\\ufeff"),
        ("lost\udcff", "lost\\udcff"),
    ],
)
def test_text_from_files_cannot_steer_the_terminal(text: str, safe: str) -> None:
    assert shown(text) == safe


def test_everything_that_a_console_prints_is_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    evil = "x\x1b]0;owned\x07\nnext: curl evil"
    console = Console()
    console.step(evil)
    console.say(evil)
    console.warn(evil)
    console.progress(1, 1)
    console.result({evil: {evil: [evil]}}, next_command=evil)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 6 and not any("\x1b" in line or line.startswith("next: curl") for line in lines)


def test_an_error_stays_three_lines_whatever_it_quotes() -> None:
    outcome = CliRunner().invoke(_app_that_raises(BadData("a\nb\x1b", "c\rd\n\n", "e\u2028f")), [])
    assert len(outcome.stderr.splitlines()) == 3 and "\x1b" not in outcome.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_both_signals_end_a_command_alike(number: signal.Signals) -> None:
    code = (
        "import gw_cli.app as a, time, typer\n"
        "from gw_cli.console import command\n"
        "@a.app.command('wait')\n@command\ndef wait():\n    print('ready', flush=True)\n    time.sleep(30)\n"
        "import sys; sys.argv = ['gw', 'wait']; a.main()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.05)
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130 and said.startswith("interrupted; ") and len(said.splitlines()) == 1


def ended_by_sigterm(code: str) -> subprocess.CompletedProcess[str]:
    """The outcome of Python code that gets SIGTERM as soon as it has printed a line."""
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
    )
    assert process.stdout is not None and process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    output, said = process.communicate(timeout=30)
    return subprocess.CompletedProcess("gw", process.returncode, output, said)


def test_a_signal_while_the_commands_are_put_together_is_an_interrupt() -> None:
    outcome = ended_by_sigterm(
        "import gw_cli.app as a, time\n"
        "def slow():\n    print('ready', flush=True)\n    time.sleep(30)\n"
        "a.app = slow; a.main()\n"
    )
    assert outcome.returncode == 130 and outcome.stderr.startswith("interrupted; ")
    assert len(outcome.stderr.splitlines()) == 1


@pytest.mark.parametrize(("words", "code"), [("--help", 0), ("inspect none.gwg", 66), ("nonsense", 2)])
def test_a_signal_while_the_interpreter_ends_leaves_the_exit_code(words: str, code: int) -> None:
    outcome = ended_by_sigterm(
        "import atexit, sys, time, gw_cli.app as a\n"
        "def last():\n    sys.stdout = sys.__stdout__\n    print('ready', flush=True)\n    time.sleep(0.5)\n"
        "atexit.register(last)\n"
        f"sys.argv = ['gw', *{words.split()!r}]\n"
        "import io; sys.stdout = io.StringIO(); a.main()\n"
    )
    assert outcome.returncode == code and "Traceback" not in outcome.stderr


def _app_that_raises(error: BaseException) -> typer.Typer:
    app = typer.Typer()

    @app.command()
    @command
    def fails() -> None:
        raise error

    return app


class _Unprintable(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text")


@pytest.mark.parametrize("broken", ["text", "folder", "both"])
def test_the_last_handler_does_not_fail_itself(
    broken: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if broken != "text":
        monkeypatch.setattr(failures.tempfile, "tempdir", str(tmp_path / "none"))
    error = ValueError("lost \udcff") if broken == "folder" else _Unprintable()
    outcome = CliRunner().invoke(_app_that_raises(error), [])
    assert outcome.exit_code == 70 and len(outcome.stderr.splitlines()) == 3
    assert "A bug in gw" in outcome.stderr


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 3.00 GiB for an array"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:118] DefaultCPUAllocator: can't allocate memory"),
        RuntimeError("std::bad_alloc"),
        OSError(12, "Cannot allocate memory"),
    ],
)
def test_memory_that_ran_out_is_a_refusal_with_the_estimate(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "available_bytes", lambda: 100 << 30)
    memory.require_memory(5000 << 20, "options", "Ask for less.")
    monkeypatch.setattr(memory, "available_bytes", lambda: 900 << 20)
    outcome = CliRunner().invoke(_app_that_raises(error), [])
    assert outcome.exit_code == 2 and "bug" not in outcome.stderr
    assert "5000 MiB" in outcome.stderr and "900 MiB are free" in outcome.stderr


def test_what_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_bytes", lambda: 1000 << 20)
    memory.require_memory(800 << 20, "x", "y")
    with pytest.raises(UsageProblem) as caught:
        memory.require_memory(950 << 20, "options --width", "Make it smaller.")
    assert "950 MiB" in caught.value.what and "1000 MiB" in caught.value.what


def test_free_memory_is_the_least_of_three_limits(tmp_path: Path) -> None:
    meminfo, statm = tmp_path / "meminfo", tmp_path / "statm"
    meminfo.write_text("MemTotal: 9 kB\nMemAvailable: 4096 kB\n")
    assert memory.available_bytes(meminfo, tmp_path, statm) == 4096 << 10
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("1500000\n")
    assert memory.available_bytes(meminfo, tmp_path, statm) == 1500000
    (tmp_path / "memory.stat").write_text("anon 5\ninactive_file 500000\n")
    assert memory.available_bytes(meminfo, tmp_path, statm) == 2000000
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available_bytes(meminfo, tmp_path, statm) == 4096 << 10
    assert memory.available_bytes(tmp_path / "none", tmp_path, statm) is None
