"""The takes that a run learns from, as one sequence with one numbering of frames and one set of poses.

Frames of the first take keep their numbers. Every other take starts after the last pose of the take before
it and a pause in its own first pose. The pause is longer than the motion features remember.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.avatar.pose import time_constant
from stages.shared.body import BodyModel, Poses, shaped_joints
from stages.shared.capture import Camera, Take
from stages.shared.capture.camera import Box
from stages.shared.errors import BadData, UsageProblem

_MOTION_FEATURES = 6  # the most that a run can have
_PAUSE = 6.0  # time constants of the longest of them
_SAME_RATE = 1e-3  # frames per second


@dataclass(frozen=True)
class TakeSequence:
    """Takes one after the other.

    Attributes:
        takes: the one of the template first. starts: number of frame 0 of each.
    """

    takes: tuple[Take, ...]
    starts: tuple[int, ...] = (0,)

    @property
    def name(self) -> str:
        return ", ".join(take.name for take in self.takes)

    @property
    def frames(self) -> list[int]:
        """Numbers of all frames with pictures."""
        return self.every(1)

    @property
    def training_cameras(self) -> tuple[str, ...]:
        """Those that all takes have, in the order of the first."""
        first, *others = (take.training_cameras for take in self.takes)
        return tuple(name for name in first if all(name in other for other in others))

    @property
    def heldout_cameras(self) -> tuple[str, ...]:
        first, *others = (take.heldout_cameras for take in self.takes)
        return tuple(name for name in first if all(name in other for other in others))

    def every(self, step: int) -> list[int]:
        """Numbers of every `step`-th frame of each take."""
        pairs = zip(self.takes, self.starts, strict=True)
        return [start + frame for take, start in pairs for frame in take.frames[::step]]

    def groups(self, frames: Sequence[int]) -> list[list[int]]:
        """Indices into `frames`, by take."""
        groups: list[list[int]] = [[] for _ in self.takes]
        for index, frame in enumerate(frames):
            groups[self._take_index(frame)].append(index)
        return [group for group in groups if group]

    def camera(self, camera: str, frame: int) -> Camera:
        """A camera with its calibration in the take of a frame."""
        return self.takes[self._take_index(frame)].camera(camera)

    def has_image(self, camera: str, frame: int) -> bool:
        take, row = self._locate(frame)
        return take.has_image(camera, row)

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """As `Take.image`; the same for those below."""
        take, row = self._locate(frame)
        return take.image(camera, row)

    def mask(self, camera: str, frame: int) -> NDArray[np.uint8]:
        take, row = self._locate(frame)
        return take.mask(camera, row)

    def labels(self, camera: str, frame: int) -> NDArray[np.uint8] | None:
        take, row = self._locate(frame)
        return take.labels(camera, row)

    def subject_box(self, camera: str, frame: int, margin: int) -> Box | None:
        take, row = self._locate(frame)
        return take.subject_box(camera, row, margin=margin)

    def frame_name(self, frame: int) -> str:
        """A frame by its number within its take, after the name of the take where there are several."""
        take, row = self._locate(frame)
        return str(row) if len(self.takes) == 1 else f"{take.name}/{row}"

    def _locate(self, frame: int) -> tuple[Take, int]:
        index = self._take_index(frame)
        return self.takes[index], frame - self.starts[index]

    def _take_index(self, frame: int) -> int:
        return bisect_right(self.starts, frame) - 1


def concatenate_takes(
    takes: Sequence[Take], poses: Sequence[Poses], body: BodyModel
) -> tuple[TakeSequence, Poses]:
    """The takes as one sequence, and its poses: row = number of the frame, shape of the first take.

    A take whose body was fitted with another shape keeps the positions of its pelvis.

    Arguments:
        poses: of each take, row = its own frame number.

    Raises:
        BadData: a frame has no pose. UsageProblem: frame rates differ, or no camera is in all takes.
    """
    for take, own in zip(takes, poses, strict=True):
        if len(own) <= max(take.frames, default=0):
            raise BadData(
                f"There are {len(own)} poses, but images up to frame {take.frames[-1]}.",
                f"take {take.name}",
                "Register the subject again with `gw register-template`.",
            )
    if len(takes) == 1:
        return TakeSequence((takes[0],)), poses[0]
    first = poses[0]
    for take, own in zip(takes, poses, strict=True):
        if abs(own.fps - first.fps) > _SAME_RATE:
            raise _apart(f"{take.name} has {own.fps:g} frames per second and {takes[0].name} {first.fps:g}.")
    pause = math.ceil(_PAUSE * time_constant(_MOTION_FEATURES - 1) * first.fps)
    parts, starts, rows = [first], [0], len(first)
    for own in poses[1:]:
        moved = _with_shape(own, first.betas, body)
        parts += [moved[[0] * pause], moved]
        starts.append(rows + pause)
        rows += pause + len(own)
    rotations, translation, expression = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("rotations", "translation", "expression")
    )
    sequence = TakeSequence(tuple(takes), tuple(starts))
    if not sequence.training_cameras:
        raise _apart("The takes have no training camera in common.")
    return sequence, replace(first, rotations=rotations, translation=translation, expression=expression)


def _with_shape(poses: Poses, betas: NDArray[np.float32], body: BodyModel) -> Poses:
    """The same motion by a body of another shape, its pelvis at the same places."""
    before, after = (shaped_joints(body, torch.from_numpy(b))[0].numpy() for b in (poses.betas, betas))
    return replace(poses, betas=betas, translation=poses.translation + (before - after))


def _apart(what: str) -> UsageProblem:
    return UsageProblem(what, "option --take", "Learn from takes that were recorded alike.")
