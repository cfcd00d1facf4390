"""Reading a BVH file: its skeleton and its motion, as written, before any interpretation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.poses import MAX_FRAMES
from stages.shared.errors import BadData

Doubles = NDArray[np.float64]

MAX_JOINTS = 2000
_MAX_DEPTH = 500
_CHANNELS = {f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}


@dataclass(frozen=True)
class BvhMotion:
    """A skeleton and T frames of motion, in the file's own units and axes.

    Attributes:
        names: B names; parents come before children, the root is first.
        parents: (B,) indices, −1 for the root.
        offsets: (B, 3) rest position relative to the parent.
        ends: for every joint with an end site the site's offset (3,).
        rotations: (T, B, 3, 3) relative to the parent.
        root_positions: (T, 3).
        fps: frames per second.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Doubles
    ends: dict[int, Doubles]
    rotations: Doubles
    root_positions: Doubles
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
            if parent < 0:
                rotations[:, joint] = self.rotations[:, joint]
                positions[:, joint] = self.root_positions
            else:
                rotations[:, joint] = rotations[:, parent] @ self.rotations[:, joint]
                positions[:, joint] = positions[:, parent] + rotations[:, parent] @ self.offsets[joint]
        return rotations, positions


def read_bvh_file(path: Path) -> BvhMotion:
    """Parse a BVH file with one skeleton.

    Rotations are applied in the order of the channels. Position channels of joints other than the root are
    read over: their bones keep the length of the hierarchy.

    Raises:
        BadData: not BVH, unknown channels, a motion that does not fit the skeleton, NaN, too large.
    """
    try:
        text = path.read_text("utf-8", errors="replace")
    except OSError as error:
        raise _bad(f"it cannot be read ({error.strerror})", path) from error
    head, marker, tail = text.partition("MOTION")
    if not marker:
        raise _bad("it has no MOTION section", path)
    names, parents, offsets, channels, ends = _hierarchy(head.split(), path)
    values, fps = _motion(tail, sum(map(len, channels)), path)
    rotations = np.tile(np.eye(3), (len(values), len(names), 1, 1))
    root_positions = np.tile(offsets[0], (len(values), 1))
    column = 0
    for joint, kinds in enumerate(channels):
        block = values[:, column : column + len(kinds)]
        column += len(kinds)
        turning = [number for number, kind in enumerate(kinds) if kind.endswith("rotation")]
        if turning:
            order = "".join(kinds[number][0] for number in turning)
            rotations[:, joint] = _turned(order, block[:, turning])
        if joint == 0:
            for number, kind in enumerate(kinds):
                if kind.endswith("position"):
                    root_positions[:, "XYZ".index(kind[0])] = block[:, number]
    return BvhMotion(names, parents, offsets, ends, rotations, root_positions, fps)


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
                offset = np.array([float(number) for number in words[place : place + 3]])
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
                if inside is None or not set(kinds) <= _CHANNELS or len(kinds) != count or count > 6:
                    raise _bad(f"it has channels {kinds}", path)
                channels[inside] = kinds
            else:
                raise _bad(f"the word {words[place - 1][:40]!r} does not belong into a hierarchy", path)
    except (ValueError, IndexError) as error:
        raise _bad("its hierarchy is broken", path) from error
    if not names or stack or not np.isfinite(np.array(offsets)).all():
        raise _bad("its hierarchy is incomplete", path)
    return tuple(names), tuple(parents), np.array(offsets), channels, ends


def _motion(text: str, columns: int, path: Path) -> tuple[Doubles, float]:
    """Values (T, columns) and frames per second out of the text behind MOTION."""
    words = text.split()
    try:
        if words[0].lower() != "frames:" or [word.lower() for word in words[2:4]] != ["frame", "time:"]:
            raise ValueError
        frames, seconds = int(words[1]), float(words[4])
    except (ValueError, IndexError) as error:
        raise _bad("its MOTION section does not begin with 'Frames:' and 'Frame Time:'", path) from error
    if not 0 < frames <= MAX_FRAMES or not 1e-5 < seconds < 1e3:
        raise _bad(f"it claims {frames} frames of {seconds} s", path)
    numbers = words[5:]
    if len(numbers) != frames * columns:
        raise _bad(
            f"it should hold {frames} frames of {columns} numbers, and holds {len(numbers)} numbers", path
        )
    try:
        values = np.array(numbers, dtype=np.float64).reshape(frames, columns)
    except ValueError as error:
        raise _bad("its motion contains something that is not a number", path) from error
    if not np.isfinite(values).all():
        frame = int(np.argwhere(~np.isfinite(values))[0, 0])
        raise _bad(f"frame {frame} contains NaN or infinity", path)
    return values, 1.0 / seconds


def _bad(reason: str, path: Path) -> BadData:
    return BadData(f"This BVH file cannot be used: {reason}.", str(path), "Export the motion again as BVH.")
