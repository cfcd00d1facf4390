"""What a run reports: the figures of a step, and curves and previews for TensorBoard.

Only this module imports tensorboardX, the extra `tensorboard`. Its files lie outside of the artifact.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.pipeline import TRAIN
from stages.shared.artifacts import Progress
from stages.shared.artifacts.files import make_folders
from stages.shared.errors import MissingInput
from stages.shared.report import Report


@dataclass
class StepReport:
    """Figures of one step.

    Attributes:
        step, frame, cameras: what the step saw. finite: False when the step was skipped.
        terms: unweighted losses, `total` weighted. gradient_norm: before clipping.
        seconds: "data", "network", "splat" (pictures with their losses), "surface", "optimiser".
    """

    step: int
    frame: int
    cameras: tuple[str, ...]
    finite: bool
    terms: dict[str, float]
    gradient_norm: float
    seconds: dict[str, float]


class StepClock:
    """Adds up seconds by name: `with clock("data"): …`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started


def metrics_line(steps: list[StepReport], scale: float) -> dict[str, Any]:
    """One line of the metrics: means over the finite steps."""
    finite = [step for step in steps if step.finite]
    number = max(len(finite), 1)

    def means(rows: list[dict[str, float]]) -> dict[str, float]:
        names = dict.fromkeys(name for row in rows for name in row)
        return {name: sum(row.get(name, 0.0) for row in rows) / number for name in names}

    return {
        "step": steps[-1].step,
        "losses": means([step.terms for step in finite]),
        "gradient_norm": sum(step.gradient_norm for step in finite) / number,
        "seconds": means([step.seconds for step in finite]),
        "image_scale": scale,
        "skipped": len(steps) - len(finite),
    }


def mean_losses(steps: list[StepReport]) -> tuple[float, float]:
    """Mean total loss and picture difference of the latest finite steps."""
    finite = [step for step in steps if step.finite] or steps[-1:]
    total, difference = (sum(step.terms.get(name, 0.0) for step in finite) for name in ("total", "l1"))
    return total / len(finite), difference / len(finite)


class TensorBoardLogger:
    """Writes event files into a folder; a run that is resumed writes one more.

    Arguments:
        folder: made if it is not there. first_step: TensorBoard ignores later steps of older event files
            there, which came after the checkpoint.
    """

    def __init__(self, folder: Path, first_step: int) -> None:
        require_tensorboard()
        events = importlib.import_module("tensorboardX.proto.event_pb2")
        self._summaries = importlib.import_module("tensorboardX.proto.summary_pb2")
        make_folders(folder)
        # Files are named by the second; the suffix separates two that start within one second.
        self._writer = importlib.import_module("tensorboardX").FileWriter(
            str(folder), filename_suffix=f".from-{first_step}"
        )
        started = events.SessionLog(status=events.SessionLog.START)
        self._writer.add_event(events.Event(session_log=started), step=first_step)

    def line(self, values: dict[str, Any]) -> None:
        """A line of the metrics: "step", and numbers by name; groups such as "losses" are nested."""
        numbers = {name: value for name, value in _flat(values).items() if name != "step"}
        tagged = [self._summaries.Summary.Value(tag=n, simple_value=float(v)) for n, v in numbers.items()]
        self._add(tagged, values["step"])

    def picture(self, png: bytes, width: int, height: int, step: int) -> None:
        """A preview: an encoded PNG in colours."""
        image = self._summaries.Summary.Image(
            height=height, width=width, colorspace=3, encoded_image_string=png
        )
        self._add([self._summaries.Summary.Value(tag="preview", image=image)], step)

    def close(self) -> None:
        """Write what is buffered."""
        self._writer.close()

    def _add(self, values: list[Any], step: int) -> None:
        self._writer.add_summary(self._summaries.Summary(value=values), step)
        self._writer.flush()


@contextmanager
def tensorboard_logger(
    root: Path | None, progress: Progress, first_step: int, report: Report
) -> Iterator[TensorBoardLogger | None]:
    """A logger into `root`/tensorboard/train-<key>; None where there is no root."""
    if root is None:
        yield None
        return
    folder = root / "tensorboard" / f"{TRAIN.name}-{progress.path.name.rpartition('-')[2]}"
    report.say(f"tensorboard --logdir {folder}")
    opened = TensorBoardLogger(folder, first_step)
    try:
        yield opened
    finally:
        opened.close()


def require_tensorboard() -> None:
    """Raises MissingInput where the extra is not installed."""
    if importlib.util.find_spec("tensorboardX") is None:
        raise MissingInput(
            "The writer of TensorBoard's files is not installed.",
            "option --tensorboard",
            "Run: pip install 'gaussian-wardrobe[tensorboard]'; or leave --tensorboard out, metrics.jsonl "
            "has the same numbers.",
        )


def _flat(values: dict[str, Any], before: str = "") -> dict[str, float]:
    """Numbers of nested groups, named "group/name"."""
    numbers: dict[str, float] = {}
    for name, value in values.items():
        numbers |= _flat(value, f"{before}{name}/") if isinstance(value, dict) else {before + name: value}
    return numbers
