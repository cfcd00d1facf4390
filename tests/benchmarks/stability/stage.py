"""Measure how errors grow with the size of the input; no subject is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stages.shared.artifacts import write_whole
from stages.shared.artifacts.canonical import readable_json
from stages.shared.errors import UsageProblem
from stages.shared.report import SILENT, Report
from tests.benchmarks.stability.config import StabilityConfig
from tests.benchmarks.stability.functions import FAMILIES, FUNCTIONS
from tests.benchmarks.stability.measure import Measured, measure, precisions

_HEADER = """# Stability

This page shows how far the result of each public numerical function is from the truth. `make docs` writes
it with `python -m tests.benchmarks.stability -o OUT`. The cases are in
`tests/benchmarks/stability/functions`. `stability.json` in OUT has the error of every function at every
magnitude and precision. `tests/extremes` runs all cases on every change, and runs each function again with
NaN and infinity in one number of every input.

An error is the largest difference from the truth, divided by the largest entry of the truth. The truth is
the float64 result on the same numbers. The gradient column is the worst error of the gradients of all
inputs. Errors are the worst ones inside the everyday range. The tests hold float32 to the limit in
brackets. *Refused from* is the first magnitude beyond that range that float32 refuses, with an error that
names the array and the index.

{cases} cases: {finite} finite, {refused} refused, {not_finite} neither.

An error of 1 has one of three causes. A value that is too small for its type became 0 (squares of 1e-30 in
float32). A value that is 0 in truth is rounding here (a round Gaussian has no orientation to differentiate
by). Or the problem has no answer at that size (an angle of 1e20 rad, where neighbouring float32 numbers are
many turns apart). bfloat16 is listed where a function takes it. It is not used in `gw`.

{glance}
"""


def run(output: Path | None, config: StabilityConfig, report: Report = SILENT) -> list[Measured]:
    """Measure every function of the chosen families at all its magnitudes in all its precisions.

    Writes stability.json and stability.md into `output`, when it is given.

    Raises:
        UsageProblem: a family that does not exist.
    """
    for family in config.families:
        if family not in FAMILIES:
            raise UsageProblem(
                f"There is no family {family!r}.",
                "option --families",
                "Choose from: " + ", ".join(FAMILIES) + ".",
            )
    chosen = [function for function in FUNCTIONS if not config.families or function.family in config.families]
    report.step("measuring errors")
    rows: list[Measured] = []
    for number, function in enumerate(chosen):
        for precision in precisions(function):
            rows += [measure(function, m, precision, config.seed) for m in function.magnitudes]
        report.progress(number + 1, len(chosen))
    if output is not None:
        write_whole(output / "stability.json", readable_json([asdict(row) for row in rows]))
        write_whole(output / "stability.md", markdown(rows).encode())
    return rows


def summary(rows: Sequence[Measured]) -> dict[str, Any]:
    """How many cases there were and how they ended."""
    outcomes = [row.outcome for row in rows]
    return {
        "cases": len(rows),
        **{name.replace(" ", "_"): outcomes.count(name) for name in ("finite", "refused", "not finite")},
        "defects": [
            f"{row.function}, {row.axis} {row.magnitude:g}" for row in rows if row.outcome == "not finite"
        ],
    }


def markdown(rows: Sequence[Measured]) -> str:
    """The page: one row per function and input."""
    return _HEADER.format(**summary(rows), glance="\n".join(_glance(rows)))


def _glance(rows: Sequence[Measured]) -> list[str]:
    """One line per function and input: its range of everyday numbers and the worst errors in it."""
    lines = ["| function | input | everyday range | float32 | gradients | bfloat16 | refused from |"]
    lines += ["| --- " * 7 + "|"]
    for function in FUNCTIONS:
        own = [row for row in rows if (row.function, row.axis) == (function.name, function.axis)]
        if not own:
            continue
        low, high = function.everyday
        everyday = [row for row in own if low <= row.magnitude <= high]
        beyond = [row.magnitude for row in own if row.precision == "float32" and row.outcome == "refused"]
        cells = [
            function.name,
            function.axis,
            f"{low:g} to {high:g}",
            _worst([row.error for row in everyday if row.precision == "float32"], function.tolerance),
            _worst(
                [row.gradient_error for row in everyday if row.precision == "float32"],
                function.gradient_tolerance,
            ),
            _worst([row.error for row in everyday if row.precision == "bfloat16"], None),
            f"{min(above):g}" if (above := [size for size in beyond if size > high]) else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _worst(errors: Sequence[float | None], limit: float | None) -> str:
    known = [error for error in errors if error is not None]
    if not known:
        return ""
    return f"{max(known):.0e}" + (f" [{limit:.0e}]" if limit is not None and limit < 1 else "")
