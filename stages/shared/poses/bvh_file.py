"""Reading a BVH file: its skeleton and its motion, as written, before any interpretation."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.poses import MAX_FRAMES
from stages.shared.errors import BadData
from stages.shared.input_files import read_text

Doubles = NDArray[np.float64]

MAX_JOINTS = 2000
MAX_FILE_BYTES = 256 << 20
_MAX_DEPTH = 500
_MAX_VALUES = 100_000_000
_CHANNELS = {f"{axis}{kind}".upper(): f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}
# The section begins with the word alone; it may also be part of the name of a bone.
_MOTION = re.compile(r"(?<!\S)MOTION\s+(?=FRAMES\b)", re.IGNORECASE)
_COUNTS = re.compile(r"FRAMES\s*:\s*(\S+)\s+FRAME\s+TIME\s*:\s*(\S+)", re.IGNORECASE)


@dataclass(frozen=True)
class BvhMotion:
    """A skeleton and T frames of motion, in the file's own units and axes.

    Attributes:
        names: B names; parents come before children, the root is first.
        parents: (B,) indices, −1 for the root.
        offsets: (B, 3) rest position relative to the parent. Of a joint with position channels it is the
            median of those, since some exporters write zeros for the offset then.
        ends: for every joint with an end site the site's offset (3,).
        rotations: (T, B, 3, 3) relative to the parent.
        positions: joint to its positions (T, 3) relative to the parent, for joints with position channels.
        fps: frames per second.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Doubles
    ends: dict[int, Doubles]
    rotations: Doubles
    positions: dict[int, Doubles]
    fps: float

    def rest_positions(self) -> Doubles:
        """(B, 3) joints with all rotations zero, the root at its offset."""
        positions = np.zeros_like(self.offsets)
        for joint, parent in enumerate(self.parents):
            positions[joint] = self.offsets[joint] + (positions[parent] if parent >= 0 else 0)
        return positions

    def world(self) -> tuple[Doubles, Doubles]:
        """World rotations (T, B, 3, 3) and positions (T, B, 3) of the joints."""
        rotations = np.zeros_like(self.rotations)
        positions = np.zeros(self.rotations.shape[:2] + (3,))
        for joint, parent in enumerate(self.parents):
            place = self.positions.get(joint, self.offsets[joint])
            if parent < 0:
                rotations[:, joint], positions[:, joint] = self.rotations[:, joint], place
            else:
                rotations[:, joint] = rotations[:, parent] @ self.rotations[:, joint]
                moved = (rotations[:, parent] @ np.broadcast_to(place, (len(rotations), 3))[..., None])[
                    ..., 0
                ]
                positions[:, joint] = positions[:, parent] + moved
        return rotations, positions


def read_bvh_file(
    path: Path, note: Callable[[str], None] = lambda text: None, fps: float | None = None
) -> BvhMotion:
    """Parse a BVH file with one skeleton.

    Rotations are applied in the order of the channels. Position channels of every joint are used.

    Arguments:
        note: is called with a sentence where the file states another number of frames than it has.
        fps: frame rate that replaces the file's frame time.

    Raises:
        BadData: not BVH, unknown channels, rows that do not fit the skeleton, values that are not finite
            numbers (named by line and text), too large.
    """
    text = read_text(path, "a BVH file", MAX_FILE_BYTES, errors="replace")
    start = _MOTION.search(text)
    if start is None:
        raise _bad("it has no MOTION section", path)
    hierarchy = re.sub(r"([{}])", r" \1 ", text[: start.start()]).split()
    names, parents, offsets, channels, ends = _hierarchy(hierarchy, path)
    first_line = text.count("\n", 0, start.end())
    values, file_fps = _motion(text[start.end() :], first_line, sum(map(len, channels)), path, note, fps)
    rotations = np.tile(np.eye(3), (len(values), len(names), 1, 1))
    positions: dict[int, Doubles] = {}
    column = 0
    for joint, kinds in enumerate(channels):
        block = values[:, column : column + len(kinds)]
        column += len(kinds)
        turning = [number for number, kind in enumerate(kinds) if kind.endswith("rotation")]
        moving = [number for number, kind in enumerate(kinds) if kind.endswith("position")]
        if turning:
            order = "".join(kinds[number][0] for number in turning)
            rotations[:, joint] = _turned(order, block[:, turning])
        if moving:
            positions[joint] = np.tile(offsets[joint], (len(values), 1))
            positions[joint][:, ["XYZ".index(kinds[number][0]) for number in moving]] = block[:, moving]
            if joint:
                offsets[joint] = np.median(positions[joint], axis=0)
    return BvhMotion(names, parents, offsets, ends, rotations, positions, file_fps)


def _turned(order: str, degrees: Doubles) -> Doubles:
    """(T, 3, 3) from any sequence of axes, the first one outermost."""
    total = np.tile(np.eye(3), (len(degrees), 1, 1))
    for number, axis in enumerate(order):
        total = total @ Rotation.from_euler(axis, degrees[:, number : number + 1], degrees=True).as_matrix()
    return total


def _hierarchy(
    words: list[str], path: Path
) -> tuple[tuple[str, ...], tuple[int, ...], Doubles, list[list[str]], dict[int, Doubles]]:
    """Names, parents, offsets, channels, and end sites out of the words before MOTION."""
    names: list[str] = []
    parents: list[int] = []
    offsets: list[Doubles] = []
    channels: list[list[str]] = []
    ends: dict[int, Doubles] = {}
    stack: list[int | None] = []  # open blocks; None is an end site
    opening: int | None = -1
    place = 0
    try:
        while place < len(words):
            word = words[place].upper()
            place += 1
            if word == "HIERARCHY":
                continue
            if word in ("ROOT", "JOINT"):
                if word == "ROOT" and names:
                    raise _bad("it holds more than one skeleton", path)
                above = stack[-1] if stack else -1
                if above is None or len(names) >= MAX_JOINTS:
                    raise _bad("its hierarchy is broken or too large", path)
                start = place
                while words[place] != "{":
                    place += 1
                names.append(" ".join(words[start:place]))
                parents.append(above)
                offsets.append(np.zeros(3))
                channels.append([])
                opening = len(names) - 1
            elif word == "END":
                place += 1  # "Site"
                opening = None
            elif word == "{":
                stack.append(opening)
                if len(stack) > _MAX_DEPTH:
                    raise _bad("its hierarchy is nested too deeply", path)
            elif word == "}":
                stack.pop()
            elif word == "OFFSET":
                offset = np.array([_number(text) for text in words[place : place + 3]])
                place += 3
                inside = stack[-1]
                if inside is not None:
                    offsets[inside] = offset
                elif len(stack) > 1 and (owner := stack[-2]) is not None:
                    ends[owner] = offset
            elif word == "CHANNELS":
                count = int(words[place])
                kinds = words[place + 1 : place + 1 + count]
                place += 1 + count
                inside = stack[-1]
                known = [_CHANNELS.get(kind.upper(), "") for kind in kinds]
                if inside is None or not all(known) or len(kinds) != count or count > 6:
                    raise _bad(f"it has channels {kinds}", path)
                channels[inside] = known
            else:
                raise _bad(f"the word {words[place - 1][:40]!r} is not known in a hierarchy", path)
    except (ValueError, IndexError) as error:
        raise _bad("its hierarchy is broken", path) from error
    if not names or stack or any(offset.shape != (3,) for offset in offsets):
        raise _bad("its hierarchy is incomplete", path)
    return tuple(names), tuple(parents), np.array(offsets), channels, ends


def _motion(
    text: str, first_line: int, columns: int, path: Path, note: Callable[[str], None], fps: float | None
) -> tuple[Doubles, float]:
    """Values (T, columns) and frames per second out of the text behind MOTION.

    Arguments:
        first_line: lines of the file before `text`.
    """
    counts = _COUNTS.match(text)
    try:
        if counts is None:
            raise ValueError
        claimed, seconds = int(counts[1]), _number(counts[2])
    except ValueError as error:
        raise _bad("its MOTION section does not begin with 'Frames:' and 'Frame Time:'", path) from error
    if fps is None and not 1e-5 < seconds < 1e3:
        raise _bad(f"it claims frames of {seconds} s", path)
    if text.count(" ") + text.count("\t") + text.count("\n") > 2 * _MAX_VALUES or not columns:
        raise _bad("it has no channels, or more than 100 million numbers", path)
    first_line += text.count("\n", 0, counts.end())
    lines = enumerate(text[counts.end() :].splitlines(), first_line + 1)
    rows = [(number, line.split()) for number, line in lines if line.strip()]
    if any(len(words) != columns for _, words in rows):
        rows = _rewrapped(rows, columns, claimed, path)
    if not 0 < len(rows) <= MAX_FRAMES:
        raise _bad(f"it holds {len(rows)} frames", path)
    values = np.empty((len(rows), columns))
    for index, (number, words) in enumerate(rows):
        try:
            values[index] = words
        except ValueError:
            values[index] = [_value(word, number, path) for word in words]
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        number, words = rows[int(wrong[0, 0])]
        raise _bad(f"line {number} holds NaN or infinity: {words[int(wrong[0, 1])][:40]!r}", path)
    if claimed != len(rows):
        note(f"the file states {claimed} frames and holds {len(rows)} rows: all rows are read.")
    return values, fps or 1.0 / seconds


def _rewrapped(
    rows: list[tuple[int, list[str]]], columns: int, claimed: int, path: Path
) -> list[tuple[int, list[str]]]:
    """Rows of `columns` words where frames run over several lines, as long as their total is right.

    Raises:
        BadData: the total is not right; the first line with another number of values is named.
    """
    words = [word for _, line in rows for word in line]
    if len(words) == claimed * columns and all(len(line) < columns for _, line in rows):
        return [(rows[0][0], words[i : i + columns]) for i in range(0, len(words), columns)]
    number, line = next((number, line) for number, line in rows if len(line) != columns)
    odd = [word for word in line if not _is_number(word)]
    near = f", near {odd[0][:40]!r}" if odd else ""
    raise _bad(f"line {number} has {len(line)} numbers, {columns} are expected{near}", path)


def _number(word: str) -> float:
    """A number with a decimal point or a decimal comma. Raises ValueError."""
    return float(word.replace(",", ".") if "." not in word else word)


def _is_number(word: str) -> bool:
    try:
        _number(word)
    except ValueError:
        return False
    return True


def _value(word: str, line: int, path: Path) -> float:
    try:
        return _number(word)
    except ValueError as error:
        raise _bad(f"line {line} holds {word[:40]!r}, which is not a number", path) from error


def _bad(reason: str, path: Path) -> BadData:
    return BadData(f"This BVH file cannot be used: {reason}.", str(path), "Export the motion again as BVH.")
