"""`gw tryon --tradeoff`: the operating point that is asked for is worn, and what it costs is said."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.workflows.tradeoff.config import BenchTradeoffConfig
from stages.workflows.tradeoff.front import OperatingPoint
from stages.workflows.tradeoff.stage import write_results

BEST = OperatingPoint("best", 6.5, "networks", 900, 17.0, 0.84, 0.9, 0.5, {
    "psnr_foreground": 13.0, "ssim_foreground": 0.7, "miou": 0.8, "sharpness": 0.5,
}, 2.0, 5.0, 10**6, 10**8)  # fmt: skip
MIDDLE = replace(BEST, name="middle", frames_per_second=30.0, psnr_foreground=16.8)
FAST = replace(BEST, name="fast", frames_per_second=90.0, psnr_foreground=15.0)
LAYERS = {"best": ("body", "lower", "upper"), "middle": ("body", "upper"), "fast": ("body",)}


@pytest.fixture
def measured(wardrobe: Path, tmp_path: Path) -> Path:
    """A folder as the bench leaves it; each point has other layers, so that one can tell them apart."""
    folder = tmp_path / "tradeoff"
    folder.mkdir()
    write_results(folder, "subject", [BEST, MIDDLE, FAST], BenchTradeoffConfig())
    for name, layers in LAYERS.items():
        (folder / "points" / name).mkdir(parents=True)
        for layer in layers:
            shutil.copy(wardrobe / f"{layer}.gwg", folder / "points" / name)
    return folder


def _words(wardrobe: Path, folder: Path, *options: str) -> list[str]:
    out = ["--poses", str(wardrobe / "motion.npz"), "-o", str(folder.parent / "out"), "--preset", "tiny"]
    return ["tryon", "--tradeoff", str(folder), *out, "--frames", "0:1", "--json", *options]


def _result(wardrobe: Path, folder: Path, *options: str) -> dict[str, Any]:
    done = CliRunner().invoke(app, _words(wardrobe, folder, *options))
    assert done.exit_code == 0, done.output
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])["result"]
    return found


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (["--fps", "25"], "middle"),
        (["--fps", "1"], "best"),
        (["--fps", "60"], "fast"),
        (["--quality", "0.3"], "middle"),
        (["--quality", "0.1 dB"], "best"),
        (["--quality", "5dB"], "fast"),
        (["--quality", "5", "--fps", "25"], "middle"),
    ],
)
def test_what_is_asked_for_is_worn(wardrobe: Path, measured: Path, options: list[str], name: str) -> None:
    planned = _result(wardrobe, measured, *options, "--dry-run")
    assert planned["config"]["layers"] == list(LAYERS[name])
    assert all(f"/points/{name}/" in path for path in planned["inputs"][:-1])


def test_film_says_what_was_given_up(wardrobe: Path, measured: Path) -> None:
    found = _result(wardrobe, measured, "--quality", "0.3")
    assert found["operating_point"] == "middle" and found["layers"] == ["body", "upper"]
    assert found["measured_frames_per_second"] == 30.0 and "0.20 dB" in found["given_up"]
    assert (measured.parent / "out" / "frames" / "000000.png").is_file()


def test_what_cannot_be_is_refused(wardrobe: Path, measured: Path, tmp_path: Path) -> None:
    words = _words(wardrobe, measured)
    body, motion = str(wardrobe / "body.gwg"), str(wardrobe / "motion.npz")
    for asked, code, said in (
        ([*words, "--fps", "100"], 66, "90.0"),
        ([*words, "--fps", "60", "--quality", "0.3"], 66, "30.0"),
        (words, 2, "--quality"),
        ([*words, "--quality", "good"], 2, "decibels"),
        ([*words, "--quality", "-1"], 2, "decibels"),
        ([*words, "--quality", "1", body], 2, "clear what is worn"),
        (["tryon", body, "--poses", motion, "--quality", "1"], 2, "--tradeoff FOLDER"),
        (["tryon", "--tradeoff", str(tmp_path), "--poses", motion, "--fps", "9"], 66, "gw bench tradeoff"),
    ):
        failed = CliRunner().invoke(app, asked)
        assert failed.exit_code == code and said in failed.stderr, (asked, failed.stderr)
    shutil.rmtree(measured / "points" / "middle")
    failed = CliRunner().invoke(app, [*words, "--fps", "25"])
    assert failed.exit_code == 66 and "are gone" in failed.stderr
