"""`gw demo`: run the whole chain on two synthetic subjects and write a page about it.

Reads nothing. Writes into the demo folder: what every command writes (`synthetic/`, `subject_1/`,
`subject_2/`, `wardrobe/`, `tryon/`, `evaluation/`), `steps.json` (command, seconds, peak bytes and
result of each step), `contact_sheet.png` and `index.html`.

Every step is a child process that runs the very command shown on the page. A step whose command and
whose predecessors' results have not changed is not run again.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.shared.artifacts import write_whole
from stages.shared.artifacts.files import make_folders
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_folder_target
from stages.workflows.command import RunCommand
from stages.workflows.demo.config import DemoConfig
from stages.workflows.demo.page import write_page
from stages.workflows.demo.recipe import DemoOutcome, DemoStep, steps

# Fields of a result that tell about this run and not about what it made.
_PASSING = ("seconds", "peak_bytes", "reused")


@dataclass(frozen=True)
class DemoResult:
    """Where the page is and what it says."""

    page: Path
    summary: dict[str, Any]


def plan(folder: Path, config: DemoConfig) -> Plan:
    """The commands that `run` would run."""
    check_folder_target(folder)
    return Plan(
        inputs=["nothing"],
        outputs=[str(folder / output) for step in steps(config) for output in step.outputs],
        config={f"step {number}": step.command for number, step in enumerate(steps(config), 1)},
    )


def run(folder: Path, config: DemoConfig, run_command: RunCommand, report: Report = SILENT) -> DemoResult:
    """Run every step that is not done with `run_command`, then write the page.

    Raises:
        GwError: with the exit code of the command that failed.
    """
    check_folder_target(folder)
    make_folders(folder)
    known = _read_known(folder)
    chain = steps(config)
    outcomes: list[DemoOutcome] = []
    key = ""
    for number, step in enumerate(chain, 1):
        report.step(f"[{number}/{len(chain)}] {step.command}")
        key = _key(key, step)
        outcome = _reuse(folder, step, known.get(key)) or _run_step(folder, step, run_command)
        outcomes.append(outcome)
        known[key] = {"command": step.command, "seconds": outcome.seconds,
                      "peak_bytes": outcome.peak_bytes, "result": outcome.result}  # fmt: skip
        write_whole(folder / "steps.json", json.dumps(known, indent=1, sort_keys=True).encode())
        key = _key(key, step, outcome.result)
        report.say(f"{outcome.seconds:.1f} s" + (" (done before)" if outcome.reused else ""))
    page = write_page(folder, config, outcomes)
    return DemoResult(page, _summary(page, outcomes))


def _key(previous: str, step: DemoStep, result: dict[str, Any] | None = None) -> str:
    """Chain of hashes over commands and what they made, so that a change reruns all that follows."""
    made = {name: value for name, value in (result or {}).items() if name not in _PASSING}
    text = json.dumps([previous, step.command, made], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _read_known(folder: Path) -> dict[str, Any]:
    try:
        known = json.loads((folder / "steps.json").read_text())
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _reuse(folder: Path, step: DemoStep, known: dict[str, Any] | None) -> DemoOutcome | None:
    if known is None or not all((folder / output).exists() for output in step.outputs):
        return None
    return DemoOutcome(step, known["seconds"], known["peak_bytes"], known["result"], reused=True)


def _run_step(folder: Path, step: DemoStep, run_command: RunCommand) -> DemoOutcome:
    made = run_command(*step.arguments, folder=folder)
    return DemoOutcome(step, made.seconds, made.peak_bytes, made.result)


def _summary(page: Path, outcomes: list[DemoOutcome]) -> dict[str, Any]:
    scores = {
        " ".join((outcome.step.title, outcome.step.subject)).strip(): outcome.result
        for outcome in outcomes
        if outcome.step.arguments[0] == "evaluate"
    }
    return {
        "page": str(page),
        "seconds": sum(outcome.seconds for outcome in outcomes),
        "peak_bytes": max(outcome.peak_bytes for outcome in outcomes),
        "scores": scores,
    }
