"""Curves and previews for TensorBoard, outside of the artifact. They change nothing in the training.

Only this module imports tensorboardX, the extra `tensorboard`.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stages.pipeline import TRAIN
from stages.shared.artifacts import Progress
from stages.shared.artifacts.files import make_folders
from stages.shared.errors import MissingInput
from stages.shared.report import Report


class TensorBoardLogger:
    """Writes event files into a folder; a run that is resumed writes one more.

    Arguments:
        folder: made if it is not there. first_step: TensorBoard ignores later steps of older event files
            there, which came after the checkpoint.
    """

    def __init__(self, folder: Path, first_step: int) -> None:
        require()
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
def logger(
    root: Path, progress: Progress, first_step: int, enabled: bool, report: Report
) -> Iterator[TensorBoardLogger | None]:
    """A logger into `root`/tensorboard/train-<key>; None where it is not enabled."""
    if not enabled:
        yield None
        return
    folder = root / "tensorboard" / f"{TRAIN.name}-{progress.path.name.rpartition('-')[2]}"
    report.say(f"tensorboard --logdir {folder}")
    opened = TensorBoardLogger(folder, first_step)
    try:
        yield opened
    finally:
        opened.close()


def require() -> None:
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
