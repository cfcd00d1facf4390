"""Curves and previews for TensorBoard, beside the artifact: they change nothing of what is learned.

Only this module imports tensorboardX, the extra `tensorboard`.
"""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path
from typing import Any

from stages.shared.artifacts.files import make_folders
from stages.shared.errors import MissingInput


class Board:
    """Writes event files into a folder; a run that is resumed writes one more.

    Arguments:
        folder: made if it is not there. first_step: what other event files there say from this step on is
            left out (it was after the checkpoint).
    """

    def __init__(self, folder: Path, first_step: int) -> None:
        require()
        events = importlib.import_module("tensorboardX.proto.event_pb2")
        self._summaries = importlib.import_module("tensorboardX.proto.summary_pb2")
        make_folders(folder)
        # Files are named by the second; the suffix keeps apart two that begin within one.
        self._writer = importlib.import_module("tensorboardX").FileWriter(
            str(folder), filename_suffix=f".from-{first_step}"
        )
        started = events.SessionLog(status=events.SessionLog.START)
        self._writer.add_event(events.Event(session_log=started), step=first_step)

    def line(self, values: dict[str, Any]) -> None:
        """A line of the metrics: "step", and numbers by name, also in groups ("losses")."""
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
        """Write what is waiting."""
        self._writer.close()

    def _add(self, values: list[Any], step: int) -> None:
        self._writer.add_summary(self._summaries.Summary(value=values), step)
        self._writer.flush()


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
    found: dict[str, float] = {}
    for name, value in values.items():
        found |= _flat(value, f"{before}{name}/") if isinstance(value, dict) else {before + name: value}
    return found
