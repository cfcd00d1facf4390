"""`gw demo`: run the whole chain on two synthetic subjects and write a page about it.

Reads nothing. Writes into the demo folder: what every command writes (`synthetic/`, `subject_1/`,
`subject_2/`, `wardrobe/`, `tryon/`, `evaluation/`), `steps.json` (command, seconds, peak bytes and
result of each step), `contact_sheet.png` and `index.html`.

Every step is a child process that runs the very command shown on the page. The two subjects are learned at
the same time, each on half of the cores. A step is not run again when neither its command nor the results
before it have changed.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Lock
from typing import Any

from stages.pipeline import BY_NAME
from stages.shared.artifacts import write_whole
from stages.shared.artifacts.files import make_folders
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_folder_target
from stages.workflows.command import RunCommand
from stages.workflows.demo.page import write_page
from stages.workflows.demo.recipe import (
    SUBJECTS,
    DemoConfig,
    DemoOutcome,
    DemoStep,
    exchange,
    learn,
    steps,
    synthesise,
)

# Fields of a result that describe the run, not the files it wrote.
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
    started = time.monotonic()
    runner = _Runner(folder, run_command, report, len(steps(config)), _read_finished(folder))
    captures, key = runner.chain(synthesise(config), "")
    cores = os.cpu_count() or 1
    with ThreadPoolExecutor(min(cores, len(SUBJECTS))) as pool:
        share = max(1, cores // len(SUBJECTS))
        chains = [pool.submit(runner.chain, learn(subject, config), key, share) for subject in SUBJECTS]
        try:
            for chain in wait(chains, return_when=FIRST_EXCEPTION).done:
                chain.result()
        except BaseException:
            runner.cancelled.set()
            raise
    learned, keys = zip(*(chain.result() for chain in chains), strict=True)
    changed, _ = runner.chain(exchange(config), "".join(keys))
    outcomes = [*captures, *(outcome for outcomes in learned for outcome in outcomes), *changed]
    seconds = time.monotonic() - started
    page = write_page(folder, config, outcomes, seconds)
    return DemoResult(page, _summary(page, outcomes, seconds))


@dataclass(eq=False)
class _Runner:
    """Runs steps and keeps `steps.json`."""

    folder: Path
    run_command: RunCommand
    report: Report
    total: int
    finished: dict[str, Any]
    number: int = 0
    cancelled: Event = field(default_factory=Event)
    lock: Lock = field(default_factory=Lock)

    def chain(
        self, steps: list[DemoStep], key: str, threads: int | None = None
    ) -> tuple[list[DemoOutcome], str]:
        """Outcomes of steps that build on each other, and the key of their results."""
        outcomes = []
        for step in steps:
            with self.lock:
                self.number += 1
                self.report.step(f"[{self.number}/{self.total}] {step.command}")
            key = _key(key, step)
            outcome = self._reuse(step, self.finished.get(key)) or self._run(step, threads)
            outcomes.append(outcome)
            with self.lock:
                self.finished[key] = {"command": step.command, "seconds": outcome.seconds,
                                   "peak_bytes": outcome.peak_bytes, "result": outcome.result}  # fmt: skip
                write_whole(
                    self.folder / "steps.json", json.dumps(self.finished, indent=1, sort_keys=True).encode()
                )
                before = " (done before)" if outcome.reused else ""
                self.report.say(
                    f"{step.arguments[0]} {step.subject}".strip() + f": {outcome.seconds:.1f} s{before}"
                )
            key = _key(key, step, outcome.result)
        return outcomes, key

    def _run(self, step: DemoStep, threads: int | None) -> DemoOutcome:
        outcome = self.run_command(
            *step.arguments, folder=self.folder, threads=threads, cancelled=self.cancelled
        )
        return DemoOutcome(step, outcome.seconds, outcome.peak_bytes, outcome.result)

    def _reuse(self, step: DemoStep, record: dict[str, Any] | None) -> DemoOutcome | None:
        if record is None or not all((self.folder / output).exists() for output in step.outputs):
            return None
        return DemoOutcome(step, record["seconds"], record["peak_bytes"], record["result"], reused=True)


def _key(previous: str, step: DemoStep, result: dict[str, Any] | None = None) -> str:
    """Chain of hashes over commands and their results, so that a change reruns all that follows.

    A stage whose code has changed runs again, too.
    """
    spec = BY_NAME.get(step.arguments[0])
    code_version = None if spec is None else spec.code_version
    content = {name: value for name, value in (result or {}).items() if name not in _PASSING}
    text = json.dumps([previous, step.command, code_version, content], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _read_finished(folder: Path) -> dict[str, Any]:
    try:
        finished = json.loads((folder / "steps.json").read_text())
    except (OSError, ValueError):
        return {}
    return finished if isinstance(finished, dict) else {}


def _summary(page: Path, outcomes: list[DemoOutcome], seconds: float) -> dict[str, Any]:
    scores = {
        " ".join((outcome.step.title, outcome.step.subject)).strip(): outcome.result
        for outcome in outcomes
        if outcome.step.arguments[0] == "evaluate"
    }
    return {
        "page": str(page),
        "seconds": seconds,
        "peak_bytes": max(outcome.peak_bytes for outcome in outcomes),
        "scores": scores,
    }
