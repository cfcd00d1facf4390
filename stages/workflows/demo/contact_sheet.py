"""One picture that shows the whole demo: the last picture of each step, in order, in equal cells."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stages.shared.artifacts import write_whole
from stages.workflows.demo.recipe import DemoOutcome

_CELL_WIDTH, _CELL_HEIGHT, _CAPTION = 480, 360, 28
_COLUMNS = 4
_PAPER, _INK = 250, 30


def write_contact_sheet(folder: Path, outcomes: list[DemoOutcome]) -> Path | None:
    """Write `contact_sheet.png` from the steps that left a picture; None when none did."""
    cells = []
    for outcome in outcomes:
        pictures = [name for name in outcome.pictures(folder) if name.endswith(".png")]
        if pictures:
            caption = " ".join(filter(None, (outcome.step.title, outcome.step.subject)))
            cells.append(_cell(folder / pictures[-1], caption))
    if not cells:
        return None
    cells += [np.full_like(cells[0], _PAPER)] * (-len(cells) % _COLUMNS)
    rows = [np.hstack(cells[start : start + _COLUMNS]) for start in range(0, len(cells), _COLUMNS)]
    path = folder / "contact_sheet.png"
    write_whole(path, cv2.imencode(".png", np.vstack(rows))[1].tobytes())
    return path


def _cell(path: Path, caption: str) -> np.ndarray:
    """The picture at `path`, fitted into a cell with its caption. (H, W, 3) uint8, BGR."""
    cell = np.full((_CELL_HEIGHT + _CAPTION, _CELL_WIDTH, 3), _PAPER, np.uint8)
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is not None:
        height, width = picture.shape[:2]
        factor = min(_CELL_WIDTH / width, _CELL_HEIGHT / height)
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)
        top, left = (_CELL_HEIGHT - size[1]) // 2, (_CELL_WIDTH - size[0]) // 2
        cell[top : top + size[1], left : left + size[0]] = small
    place = (8, _CELL_HEIGHT + _CAPTION - 9)
    cv2.putText(cell, caption, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (_INK,) * 3, 1, cv2.LINE_AA)
    return cell
