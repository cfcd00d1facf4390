"""What two processes go through together, started by `torchrun -m tests.stages.train.scenarios FOLDER NAME…`.

FOLDER/<name>/subject is trained in every scenario; each process notes how it ended in
FOLDER/<name>/rank-<r>.json.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from stages.shared.avatar.config import PAPER_MODEL
from stages.shared.errors import GwError
from stages.train import stage, trainer
from stages.train.config import LearningRates, TrackConfig, TrainConfig
from stages.train.distributed import Processes, joined
from tests.listening import Listener
from tests.stages.train.scene import TINY, tiny

TRACKED = tiny(
    steps=20,
    views_per_step=2,
    track=TrackConfig(frame_step=1, cell=2, warm_up=3, rounds=1, collision=1.0),
    model=replace(TINY.model, anchors=4, history=1),
)
PUBLISHED = tiny(
    steps=20,
    views_per_step=1,
    model=replace(PAPER_MODEL, width=0.0625, depth=2, style=8),
    rates=LearningRates(network=1e-3),
)
SHORT = tiny(steps=8, views_per_step=1)
CONFIGS: dict[str, TrainConfig] = {"tracked": TRACKED, "published": PUBLISHED}


def at_step(number: int, action: Callable[[], None]) -> Callable[[], None]:
    """Do something before a step; returns what undoes that."""
    genuine = trainer.Trainer.step

    def step(self: trainer.Trainer, current: int, elapsed: float) -> trainer.StepReport:
        if current == number:
            action()
        return genuine(self, current, elapsed)

    trainer.Trainer.step = step  # type: ignore

    def undo() -> None:
        trainer.Trainer.step = genuine  # type: ignore[method-assign]

    return undo


def spoil_pictures() -> None:
    """Make the next picture's losses NaN."""
    genuine = trainer.picture_terms

    def spoilt(*arguments: object) -> dict[str, torch.Tensor]:
        trainer.picture_terms = genuine
        return {name: value * float("nan") for name, value in genuine(*arguments).items()}  # type: ignore[arg-type]

    trainer.picture_terms = spoilt  # type: ignore[assignment]


def fail() -> None:
    """Run into an error that only this process has."""
    raise GwError("The picture is damaged.", "cam1.png", "Copy it again.")


def main(folder: Path, name: str, processes: Processes) -> None:
    """One scenario, as this process goes through it."""
    actions: dict[str, Callable[[], None]] = {
        "nan": spoil_pictures,
        "failure": fail,
        "interrupt": lambda: os.kill(os.getpid(), signal.SIGINT),
        "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    }
    undo = at_step(5, actions[name]) if name in actions and processes.rank == 1 else lambda: None
    heard, ended = Listener(), "done"
    try:
        with processes.failing_together():
            stage.run(folder / name / "subject", CONFIGS.get(name, SHORT), heard, processes=processes)
    except GwError as error:
        ended = f"{type(error).__name__}: {error.what}"
    except KeyboardInterrupt:
        ended = "interrupted"
    undo()
    note = {"ended": ended, "warnings": heard.warnings, "said": heard.said}
    (folder / name / f"rank-{processes.rank}.json").write_text(json.dumps(note))


if __name__ == "__main__":
    torch.set_num_threads(1)
    with joined("cpu"):
        for chosen in sys.argv[2:]:
            with joined("cpu") as fresh:
                main(Path(sys.argv[1]), chosen, fresh)
