"""Results and plans in people's units; bars on a terminal."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from typer.testing import CliRunner

from gw_cli import streams
from gw_cli.app import app
from gw_cli.console import Console
from gw_cli.readable import duration, folded_paths, plan_lines, result_lines, size
from stages.shared.plan import Plan

DIGEST = "0e4c1be772d182d5e51eaa677cbe81040f29af7f19fe7baa02b0aa3638020d54"


@pytest.mark.parametrize(
    ("function", "value", "text"),
    [
        (duration, 0.34, "0.3 s"),
        (duration, 12.4, "12 s"),
        (duration, 59.7, "1 min 00 s"),
        (duration, 192, "3 min 12 s"),
        (duration, 7500, "2 h 05 min"),
        (size, 812, "812 bytes"),
        (size, 12_340_000, "12.3 MB"),
    ],
)
def test_units(function: Callable[[float], str], value: float, text: str) -> None:
    assert function(value) == text


def test_what_was_made_comes_first_and_digests_need_verbose() -> None:
    result = {
        "gaussians": 31204,
        "path": "out",
        "digest": DIGEST,
        "bytes": 2_500_000,
        "seconds": {"pose": 75.0, "film": 0.5},
        "rows": list(range(20)),
        "note": "",
    }
    assert list(result_lines(result)) == [
        "made: out",
        "gaussians: 31,204",
        "size: 2.5 MB",
        "time: pose 1 min 15 s, film 0.5 s",
        "rows: 20 entries (-v lists them)",
    ]
    everything = list(result_lines(result, verbose=True))
    assert f"digest: {DIGEST}" in everything and "rows: " + ", ".join(map(str, range(20))) in everything


def test_a_plan_folds_the_files_of_one_folder() -> None:
    masks = [f"take/masks/cam{camera}/{frame:03}.png" for camera in range(10) for frame in range(32)]
    images = [path.replace("masks", "images") for path in masks]
    rows = folded_paths(["body.npz", *images, *masks])
    assert rows == ["body.npz", "320 .png files in take/images", "320 .png files in take/masks"]
    assert folded_paths(masks[:3]) == masks[:3]
    lines = list(plan_lines(Plan(masks, ["out"], memory_bytes=3_000_000, seconds=70)))
    assert lines == [
        "reads  320 .png files in take/masks",
        "writes out",
        "estimated time 1 min 10 s, memory 3.0 MB, disk unknown",
    ]


def test_verbose_is_an_option_of_every_command_with_a_result(tmp_path: object) -> None:
    golden = "tests/golden/body-1.1.gwg"
    short, long = (CliRunner().invoke(app, ["inspect", golden, *more]).stderr for more in ([], ["-v"]))
    assert "digest" not in short and "digest: " in long


def test_a_terminal_gets_a_bar_and_a_line_that_stays(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(streams, "is_terminal", lambda name: True)
    console = Console()
    console.step("training\x07")
    console.progress(1, 4)
    console.warn("slow")
    console.progress(4, 4, loss=0.5)
    console.result({"path": "out"}, next_command=("gw", "train", "my subject"), when="all is done")
    printed = capsys.readouterr()
    assert printed.out == "" and "loss 0.5" in printed.err and "\x07" not in printed.err
    last = [line.split("\x1b[2K")[-1] for line in printed.err.splitlines()][-3:]
    assert last == ["  training\\x07", "  made: out", "next: gw train 'my subject'   # all is done"]


def test_without_a_terminal_progress_is_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    console.step("training")
    for done in range(1, 2001):
        console.progress(done, 2000)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "  training …" and lines[-1].startswith("  training 2000/2000") and len(lines) <= 3
