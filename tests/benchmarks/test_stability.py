"""The measurement itself finds what it is for, and the published table is that of today's functions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.benchmarks.stability.__main__ import app
from tests.benchmarks.stability.function import Function
from tests.benchmarks.stability.functions import FUNCTIONS
from tests.benchmarks.stability.measure import measure, relative_error
from tests.benchmarks.stability.stage import markdown, summary

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "stability.md"


def _function(call, tolerance: float = 1e-6) -> Function:
    return Function(
        "tried", "test", "x", (1.0,), lambda size, random: {"x": size * np.array([1.0, 2.0, 3.0])}, call,
        everyday=(0.0, 1.0), tolerance=tolerance, gradients=("x",),
    )  # fmt: skip


def test_cancellation_shows_in_float32_and_not_in_float64() -> None:
    function = _function(lambda a: (a["x"] + 1e6) - 1e6)
    single = measure(function, 0.1, "float32")
    assert single.error is not None and 1e-3 < single.error < 1
    double = measure(function, 0.1, "float64")
    assert double.error is not None and double.error < 1e-8


def test_a_result_that_is_not_finite_is_a_defect() -> None:
    found = measure(_function(lambda a: a["x"] / 0.0), 1.0, "float32")
    assert found.outcome == "not finite"
    assert summary([found])["defects"] == ["tried, x 1"]
    assert "0 refused, 1 neither." in markdown([found])


def test_a_gradient_that_is_not_finite_is_a_defect() -> None:
    found = measure(_function(lambda a: (a["x"] - a["x"].detach()).sqrt()), 1.0, "float32")
    assert found.outcome == "not finite"


@pytest.mark.parametrize(
    ("found", "truth", "expected"),
    [([1.0, 2.0], [1.0, 4.0], 0.5), ([0.0], [0.0], 0.0), ([1.0], [0.0], np.inf)],
)
def test_relative_error(found: list[float], truth: list[float], expected: float) -> None:
    assert relative_error(np.array(found), np.array(truth)) == expected


def test_the_command_writes_the_table(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["--families", "bundles", "-o", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])["result"]
    rows = json.loads((tmp_path / "stability.json").read_text())
    assert found["cases"] == len(rows) == found["finite"] + found["refused"] > 10
    assert "| arrays on disk |" in (tmp_path / "stability.md").read_text()


def test_an_unknown_family() -> None:
    done = CliRunner().invoke(app, ["--families", "poetry"])
    assert done.exit_code == 2 and "losses" in done.stderr


def test_the_published_table_is_of_these_functions() -> None:
    text = DOCUMENT.read_text()
    for function in FUNCTIONS:
        low, high = function.everyday
        assert f"| {function.name} | {function.axis} | {low:g} to {high:g} |" in text, function.name
    assert ", 0 neither." in text
