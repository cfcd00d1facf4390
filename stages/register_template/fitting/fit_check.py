"""Whether a fit is right: head, hands and feet against landmarks, and the shape against its spread."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from stages.register_template.fitting.bones import State
from stages.register_template.fitting.fit_views import Observation
from stages.register_template.fitting.landmark_terms import CHECKED, landmark_distances
from stages.register_template.fitting.prior import SHAPE_LIMIT
from stages.shared.body import BodyModel
from stages.shared.capture import Take
from stages.shared.capture.landmarks import Landmarks, landmarks_file, read_landmarks
from stages.shared.errors import BadData
from stages.shared.report import Report

_WRONG_M, _REFUSED_M = 0.10, 0.25  # a part this far from its landmarks is named; a body this far is refused
_ODD_BETA = 0.95 * SHAPE_LIMIT
_REFUSED_SHARE = 0.5


class FitCheck:
    """What is wrong with the fitted frames of a take: landmarks, the shape, views that show nobody."""

    def __init__(self, take: Take) -> None:
        self._take = take
        self._frames: dict[int, dict[str, float]] = {}
        self._empty: dict[str, list[int]] = {}

    def add(self, body: BodyModel, frame: int, state: State, observation: Observation) -> None:
        """Look at one fitted frame (a state of one frame)."""
        if observation.landmarks is not None:
            self._frames[frame] = landmark_distances(body, state, 0, observation.landmarks)
        names = {view.camera.name for view in observation.views}
        for name in self._take.training_cameras:
            if self._take.has_image(name, frame) and name not in names:
                self._empty.setdefault(name, []).append(frame)

    def judge(self, betas: np.ndarray, report: Report) -> dict[str, Any]:
        """Say what is wrong, and give the numbers for the report.

        Raises:
            BadData: in half of the frames a part of the body is far from its landmarks.
        """
        take = self._take
        for name, frames in self._empty.items():
            report.warn(
                f"{take.name}: nobody is seen by {name} in {len(frames)} frames, the first is {frames[0]}; "
                "these views are left out"
            )
        odd = [f"β{number} {value:+.1f}" for number, value in enumerate(betas) if abs(value) > _ODD_BETA]
        if odd:
            report.warn(
                f"{take.name}: the body's shape is unusual ({', '.join(odd)}); look at overlay.png, and "
                "check the masks and the unit of the calibration"
            )
        if not self._frames:
            return {"unusual_betas": odd}
        parts = {
            part: np.array([numbers[part] for numbers in self._frames.values()]) for part in ("all", *CHECKED)
        }
        medians = {
            part: float(np.nanmedian(values)) if np.isfinite(values).any() else None
            for part, values in parts.items()
        }
        for part in CHECKED:
            wrong = [frame for frame, numbers in self._frames.items() if numbers[part] > _WRONG_M]
            if wrong:
                report.warn(
                    f"{take.name}: the {part} are more than {100 * _WRONG_M:.0f} cm from their landmarks in "
                    f"{len(wrong)} of {len(self._frames)} frames, the first is {wrong[0]}"
                )
        far = {part: float(np.mean(values > _REFUSED_M)) for part, values in parts.items() if part != "all"}
        worst = max(far, key=lambda part: far[part])
        if far[worst] > _REFUSED_SHARE:
            raise BadData(
                f"The body does not fit: its {worst} are more than {100 * _REFUSED_M:.0f} cm from where the "
                "pictures show them.",
                f"{take.name}: {100 * far[worst]:.0f} % of the frames",
                "Check calibration, masks and --up; or give poses with the capture.",
            )
        return {"landmark_distance_m": medians, "unusual_betas": odd}


def wrong_parts(body: BodyModel, state: State, frame: int, observation: Observation) -> list[str]:
    """Parts of the body that are far from their landmarks in one frame."""
    if observation.landmarks is None:
        return []
    numbers: Mapping[str, float] = landmark_distances(body, state, frame, observation.landmarks)
    return [part for part in CHECKED if numbers[part] > _WRONG_M]


def landmark_misfit(body: BodyModel, state: State, frame: int, observation: Observation) -> float:
    """Mean distance of the parts from their landmarks, metres; 0 without landmarks."""
    if observation.landmarks is None:
        return 0.0
    numbers = landmark_distances(body, state, frame, observation.landmarks)
    values = [numbers[part] for part in CHECKED if np.isfinite(numbers[part])]
    return float(np.mean(values)) if values else 0.0


def take_landmarks(take: Take) -> Landmarks | None:
    """The landmarks of a take, read once; None where it has none."""
    path = landmarks_file(take)
    return None if path is None else _read(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=4)
def _read(path: Path, changed: int) -> Landmarks:
    return read_landmarks(path)
