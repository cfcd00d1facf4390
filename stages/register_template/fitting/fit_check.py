"""Whether a fit is right: parts of the body against landmarks and masks, the legs, the shape's spread."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from stages.register_template.fitting.body_parts import BARE_PARTS, part_vertices
from stages.register_template.fitting.bones import State, bones_of, vertices_of
from stages.register_template.fitting.fit_views import Observation
from stages.register_template.fitting.landmark_terms import CHECKED, landmark_distances
from stages.register_template.fitting.prior import SHAPE_LIMIT, SHAPE_SPREAD
from stages.register_template.fitting.view_terms import outside_m
from stages.shared.body import BodyModel
from stages.shared.body.skeleton import JOINT_INDEX
from stages.shared.capture import Take
from stages.shared.capture.landmarks import Landmarks, landmarks_file, read_landmarks
from stages.shared.errors import BadData
from stages.shared.report import Report

_WRONG_M, _REFUSED_M = 0.10, 0.25  # a part this far from its landmarks is named; a body this far is refused
_OUTSIDE_M = 0.04  # half of a part farther than this from a mask is named
_CROSSED_M = 0.06  # that a knee or an ankle may stand beyond the other one
_ODD_BETA = 0.95 * SHAPE_LIMIT
_ODD_SHAPE = 1.72 * SHAPE_SPREAD  # root mean square of ten betas that one person in a thousand exceeds
_REFUSED_SHARE = 0.5


class FitCheck:
    """What is wrong with the fitted frames of a take: parts, the shape, views that show nobody."""

    def __init__(self, take: Take) -> None:
        self._take = take
        self._distances: dict[int, dict[str, float]] = {}
        self._faults: dict[str, list[int]] = {}
        self._empty: dict[str, list[int]] = {}
        self._frames: list[int] = []

    def add(self, body: BodyModel, frame: int, state: State, observation: Observation) -> None:
        """Look at one fitted frame (a state of one frame)."""
        self._frames.append(frame)
        if observation.landmarks is not None:
            self._distances[frame] = landmark_distances(body, state, 0, observation.landmarks)
        for fault in faults(body, state, observation):
            self._faults.setdefault(fault, []).append(frame)
        names = {view.camera.name for view in observation.views}
        for name in self._take.training_cameras:
            if self._take.has_image(name, frame) and name not in names:
                self._empty.setdefault(name, []).append(frame)

    def judge(self, betas: np.ndarray, report: Report) -> dict[str, Any]:
        """Say what is wrong, and give the numbers for the report; `wrong_frames` are no good templates.

        Raises:
            BadData: in half of the frames a part of the body is far from its landmarks.
        """
        name = self._take.name
        for camera, frames in self._empty.items():
            report.warn(
                f"{name}: nobody is seen by {camera} in {len(frames)} frames, the first is {frames[0]}; "
                "these views are left out"
            )
        odd = unusual_betas(betas)
        if odd:
            report.warn(
                f"{name}: the body's shape is unusual ({', '.join(odd)}); look at overlay.png, and "
                "check the masks and the unit of the calibration"
            )
        for fault, frames in self._faults.items():
            report.warn(
                f"{name}: {fault} in {len(frames)} of {len(self._frames)} frames, the first is {frames[0]}"
            )
        self._refuse()
        wrong = sorted({frame for frames in self._faults.values() for frame in frames})
        numbers: dict[str, Any] = {"unusual_betas": odd, "wrong_frames": wrong}
        if self._distances:
            numbers["landmark_distance_m"] = {part: self._median(part) for part in ("all", *CHECKED)}
        return numbers

    def _median(self, part: str) -> float | None:
        values = np.array([numbers[part] for numbers in self._distances.values()])
        return float(np.nanmedian(values)) if np.isfinite(values).any() else None

    def _refuse(self) -> None:
        if not self._distances:
            return
        far = {
            part: float(np.mean([numbers[part] > _REFUSED_M for numbers in self._distances.values()]))
            for part in CHECKED
        }
        worst = max(far, key=lambda part: far[part])
        if far[worst] > _REFUSED_SHARE:
            raise BadData(
                f"The body does not fit: its {worst} are more than {100 * _REFUSED_M:.0f} cm from where the "
                "pictures show them.",
                f"{self._take.name}: {100 * far[worst]:.0f} % of the frames",
                "Check calibration, masks and --up; or give poses with the capture.",
            )


def faults(body: BodyModel, state: State, observation: Observation) -> list[str]:
    """What is wrong with one fitted frame, a clause each; empty where nothing is."""
    found = [
        f"the {part} are more than {100 * _WRONG_M:.0f} cm from their landmarks"
        for part in wrong_parts(body, state, 0, observation)
    ]
    vertices = vertices_of(body, state)
    for part in BARE_PARTS:
        beyond = outside_m(vertices[part_vertices(body, part)], observation.views)
        if np.median(beyond) > _OUTSIDE_M:
            found.append(f"the {part} is outside of the masks")
    if crossed_legs(body, state):
        found.append("the legs are crossed")
    return found


def crossed_legs(body: BodyModel, state: State) -> bool:
    """Whether both knees, or both ankles, stand on the other one's side of the pelvis."""
    bones = bones_of(body, state)
    across = bones.joints[JOINT_INDEX["left_hip"]] - bones.joints[JOINT_INDEX["right_hip"]]
    across /= np.linalg.norm(across)
    apart = [
        float(
            (bones.joints[JOINT_INDEX[f"left_{name}"]] - bones.joints[JOINT_INDEX[f"right_{name}"]]) @ across
        )
        for name in ("knee", "ankle")
    ]
    return min(apart) < -_CROSSED_M


def unusual_betas(betas: np.ndarray) -> list[str]:
    """Betas (10,) at their limit, and all of them together if few people have such a shape."""
    odd = [f"β{number} {value:+.1f}" for number, value in enumerate(betas) if abs(value) > _ODD_BETA]
    size = float(np.sqrt(np.mean(np.square(betas))))
    return odd or ([f"{size:.1f} standard deviations"] if size > _ODD_SHAPE else [])


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
