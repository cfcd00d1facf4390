"""The demo's own work: which steps run again, and what the page says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from threading import Event

import cv2
import numpy as np
import pytest

from gw_cli.child import CommandFailed, run_command
from stages.pipeline import BY_NAME, FIT_CLOTH
from stages.shared.errors import BadData
from stages.workflows.command import Outcome
from stages.workflows.demo import stage
from stages.workflows.demo.page import write_page
from stages.workflows.demo.recipe import SUBJECTS, DemoConfig, DemoOutcome, DemoStep, learn, steps


class Recorder:
    """Stands for the child processes: notes what would have run and leaves the outputs."""

    def __init__(self) -> None:
        self.commands: list[str] = []

    def __call__(self, *arguments: str | Path, folder: Path | None = None, **_: object) -> Outcome:
        assert folder is not None
        command = "gw " + " ".join(str(word) for word in arguments)
        self.commands.append(command)
        (step,) = [
            step for seed in (0, 1) for step in steps(DemoConfig(seed=seed)) if step.command == command
        ][:1]
        for output in step.outputs:
            (folder / output).parent.mkdir(parents=True, exist_ok=True)
            (folder / output).touch()
        return Outcome(1.0, 2**20, {"made": step.title, "seconds": float(len(self.commands))})


@pytest.fixture
def ran() -> Recorder:
    return Recorder()


def test_every_step_runs_once_and_a_second_demo_runs_none(tmp_path: Path, ran: Recorder) -> None:
    stage.run(tmp_path, DemoConfig(), ran)
    assert sorted(ran.commands) == sorted(step.command for step in steps(DemoConfig()))
    first, second = ([step.command for step in learn(name, DemoConfig())] for name in SUBJECTS)
    for chain in (first, second):  # in order, each for itself
        assert [command for command in ran.commands if command in chain] == chain
    ran.commands.clear()
    stage.run(tmp_path, DemoConfig(), ran)
    assert ran.commands == []


def test_another_seed_runs_everything_again(tmp_path: Path, ran: Recorder) -> None:
    stage.run(tmp_path, DemoConfig(seed=0), ran)
    ran.commands.clear()
    stage.run(tmp_path, DemoConfig(seed=1), ran)
    assert len(ran.commands) == len(steps(DemoConfig()))


def test_a_stage_with_new_code_runs_again(
    tmp_path: Path, ran: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.run(tmp_path, DemoConfig(), ran)
    ran.commands.clear()
    newer = replace(FIT_CLOTH, code_version=FIT_CLOTH.code_version + 1)
    monkeypatch.setitem(BY_NAME, FIT_CLOTH.name, newer)
    stage.run(tmp_path, DemoConfig(), ran)
    assert "fit-cloth" in {command.split()[1] for command in ran.commands}
    assert not {"synth", "train"} & {command.split()[1] for command in ran.commands}


def test_a_lost_output_runs_its_step_again(tmp_path: Path, ran: Recorder) -> None:
    stage.run(tmp_path, DemoConfig(), ran)
    ran.commands.clear()
    (tmp_path / "tryon/result.json").unlink()
    stage.run(tmp_path, DemoConfig(), ran)
    assert [command.split()[1] for command in ran.commands] == ["tryon"]


def test_a_failure_of_one_subject_ends_the_other(tmp_path: Path, ran: Recorder) -> None:
    def fail(*arguments: str, folder: Path, cancelled: Event, **_: object) -> Outcome:
        if arguments[:2] == ("canonicalize", "subject_2"):
            raise BadData("This one is broken.", "subject_2", "Mend it.")
        if arguments[:2] == ("train", "subject_1"):
            assert cancelled.wait(60)
            raise CommandFailed("gw train", 1, "")
        return ran(*arguments, folder=folder)

    with pytest.raises(BadData, match="broken"):
        stage.run(tmp_path, DemoConfig(), fail)  # type: ignore[arg-type]
    assert not any("tryon" in command for command in ran.commands)


def test_a_cancelled_command_ends() -> None:
    cancelled = Event()
    cancelled.set()
    with pytest.raises(CommandFailed):
        run_command("-n1", "-r1", "import time; time.sleep(600)", module="timeit", cancelled=cancelled)


def test_a_failing_command_passes_its_exit_code_on(tmp_path: Path) -> None:
    step = DemoStep("x", "x", ("canonicalize", "not-there"), ())
    with pytest.raises(CommandFailed) as caught:
        run_command(*step.arguments, folder=tmp_path)
    assert caught.value.exit_code == 66


def test_the_page_shows_commands_scores_and_pictures(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "look.png"), np.full((20, 30, 3), 90, np.uint8))
    step = DemoStep("evaluate", "How good.", ("evaluate", "s1"), (), ("*.png",), "subject_1")
    scores = {"novel_pose": {"model": {"psnr_foreground": 21.25, "iou": None}}}
    page = write_page(tmp_path, DemoConfig(), [DemoOutcome(step, 3.0, 2**20, scores)], 60.0).read_text()
    assert "gw evaluate s1" in page and "21.25" in page and 'src="look.png"' in page
    assert "subject 1 novel pose model" in page and "–" in page
    sheet = cv2.imread(str(tmp_path / "contact_sheet.png"))
    assert sheet is not None and (sheet == 90).any()


def test_titles_are_escaped(tmp_path: Path) -> None:
    step = DemoStep("<b>", "<i>", ("x",), ())
    page = write_page(tmp_path, DemoConfig(), [DemoOutcome(step, 0.0, 0, {})], 60.0).read_text()
    assert "<b>" not in page and "&lt;b&gt;" in page


def test_steps_survive_a_broken_memory(tmp_path: Path, ran: Recorder) -> None:
    (tmp_path / "steps.json").write_text("{")
    stage.run(tmp_path, DemoConfig(), ran)
    assert json.loads((tmp_path / "steps.json").read_text())
