"""A plain table: a block of numbers for each camera, separated by white space.

A block holds the camera's number or name, K (3 x 3), one line of 2 to 8 distortion coefficients (k1 k2 [p1 p2
[k3 …]]), and camera_from_world (3 x 4). Lines that begin with # are comments.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.shared.calibration.model import Calibration, lens_camera
from stages.shared.errors import BadData
from stages.shared.input_files import read_text

_BLOCK = (3, 3, 3, None, 4, 4, 4)  # numbers in a line after the name
_LIMIT = 16 << 20


def read_table(path: Path) -> Calibration:
    """The cameras of a table, named as in it.

    Raises:
        BadData: a line with another count of numbers than its place asks for.
    """
    lines = [
        line.split("#")[0].split() for line in read_text(path, "a calibration table", _LIMIT).splitlines()
    ]
    numbered = [(number + 1, parts) for number, parts in enumerate(lines) if parts]
    if not numbered or len(numbered) % (len(_BLOCK) + 1):
        raise BadData(
            f"{len(numbered)} lines of numbers are no whole blocks of {len(_BLOCK) + 1}.",
            str(path),
            "Write for every camera: its name, K (3 lines), k1 k2, camera_from_world (3 lines).",
        )
    cameras = {}
    for start in range(0, len(numbered), len(_BLOCK) + 1):
        (_, (name, *rest)), *rows = numbered[start : start + len(_BLOCK) + 1]
        values = []
        for (number, parts), count in zip(rows, _BLOCK, strict=True):
            where = f"{path}: line {number}"
            if rest or (len(parts) != count if count else not 2 <= len(parts) <= 8):
                raise BadData(
                    f"The line has {len(parts)} numbers; a block has 1, 3, 3, 3, 2 to 8, 4, 4, 4.",
                    where,
                    "Correct the table.",
                )
            try:
                values.append([float(part) for part in parts])
            except ValueError as error:
                raise BadData(f"This is no number ({error}).", where, "Correct the table.") from error
        pose = np.array(values[4:7])
        cameras[name] = lens_camera(name, None, values[:3], pose, f"{path}: camera {name}", values[3])
    return Calibration(cameras, "table", (str(path),))
