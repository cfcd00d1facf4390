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
from tests.benchmarks.stability.config import PRECISIONS, StabilityConfig
from tests.benchmarks.stability.functions import FAMILIES, FUNCTIONS
from tests.benchmarks.stability.measure import Measured, measure, precisions

_HEADER = """# Stability

How far the result of every public numerical function is from the truth, by the size of its input and by
precision. Made by `python -m tests.benchmarks.stability -o OUT` (`make docs` puts it here); the cases are
those of `tests/benchmarks/stability/functions`. `tests/extremes` runs every one of them on every change, and
each function again with NaN and infinity in one number of every input.

An entry is the largest difference from the truth over the truth's largest entry; behind the slash the same
of the gradients, the worst of all inputs. The truth is float64 on the same numbers. The float64 column is
what moving every input by one unit in the last place changes: how much the problem itself magnifies
rounding. *Refused* is an error that names the array and the index; there is no third outcome: {cases} cases,
{finite} finite, {refused} refused, {not_finite} neither. bfloat16 is listed where a function takes it, and
shows why none of this runs in it.

An entry of 1 is one of three things: a number too small for its type became 0 (squares of 1e-30 in float32);
what is 0 in truth is rounding here (round Gaussians have no orientation to differentiate by); or the problem
has no answer at that size (an angle of 1e20 rad, where neighbouring numbers are turns apart; joints that turn
by half a turn a frame, either way). What follows the garments in training (`stages/train/tracking`) is
tried by `tests/extremes` as well, on systems from 1e-200 to 1e200, layers of
one texel, pictures of nothing and cameras anywhere.

### At a glance

The worst of the everyday range, where the tests hold float32 to the limit in brackets, and the first
magnitude beyond it that float32 refuses.

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
    """One table per family: magnitude against error (of the gradients, after a slash), by precision."""
    lines = [_HEADER.format(**summary(rows), glance="\n".join(_glance(rows)))]
    for family in dict.fromkeys(row.family for row in rows):
        lines += [f"### {family[0].upper()}{family[1:]}", ""]
        lines += ["| function | input | magnitude | " + " | ".join(PRECISIONS) + " |", "| --- " * 6 + "|"]
        cells: dict[tuple[str, str, float], dict[str, str]] = {}
        for row in rows:
            if row.family == family:
                cells.setdefault((row.function, row.axis, row.magnitude), {})[row.precision] = _cell(row)
        for (function, axis, magnitude), by in cells.items():
            values = " | ".join(by.get(precision, "") for precision in PRECISIONS)
            lines.append(f"| {function} | {axis} | {magnitude:.12g} | {values} |")
        lines.append("")
    return "\n".join(lines)


def _glance(rows: Sequence[Measured]) -> list[str]:
    """One line per function and input: its range of everyday numbers and the worst errors in it."""
    lines = ["| function | input | everyday | float32 | its gradients | bfloat16 | refused from |"]
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


def _cell(row: Measured) -> str:
    if row.outcome != "finite":
        return row.outcome
    if row.error is None:
        return "finite"
    slope = "" if row.gradient_error is None else f" / {row.gradient_error:.0e}"
    return f"{row.error:.0e}{slope}"
