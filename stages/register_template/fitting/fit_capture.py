"""Poses of whole takes from masks and landmarks, and a scan of one frame if there is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stages.register_template.fitting.bones import State, bones_of
from stages.register_template.fitting.contours import views_of
from stages.register_template.fitting.fit_check import (
    FitCheck,
    landmark_misfit,
    take_landmarks,
    wrong_parts,
)
from stages.register_template.fitting.fit_scan import fit_scan
from stages.register_template.fitting.fit_views import (
    Observation,
    concatenate_states,
    first_pose,
    misfit_of,
    pose_from_landmarks,
    refine,
    track,
    with_scan,
)
from stages.register_template.fitting.landmark_terms import Targets
from stages.register_template.hull import rough_hull
from stages.shared.body import BodyModel, Poses
from stages.shared.capture import Take
from stages.shared.capture.scaled_take import reduced_to
from stages.shared.meshes.mesh import Mesh
from stages.shared.report import Report

_LONG_SIDE = 768  # pixels: twice the size at which masks are compared, and enough for labels along their edge
_SHAPE_FRAMES = 4
_CONTOUR_POINTS, _CONTOUR_POINTS_TRACKED = 400, 200
_TOGETHER = ((0.05, 6, 0.1), (0.025, 10, 0.03))
_POLISH = ((0.03, 3, 0.05),)
_LOST_TIMES, _LOST_M = 2.0, 0.01  # a frame that fits this much worse than usual is named


@dataclass(frozen=True, eq=False)
class TakesFit:
    """Poses of every take, all with one shape, and numbers for the report."""

    poses: dict[str, Poses]
    report: dict[str, Any]


def fit_takes(
    body: BodyModel, takes: Sequence[Take], scan: Mesh | None, report: Report, effort: float = 1.0
) -> TakesFit:
    """Fit all frames of all takes.

    Arguments:
        takes: the first one decides the shape. Takes with poses (`posed`) are refined from them.
        scan: of the first take's `scan_frame`, metres, clean.

    Raises:
        BadData: a frame in which no mask shows the person, or masks that have no volume in common.
    """
    takes = [reduced_to(take, _LONG_SIDE) for take in takes]
    main = takes[0]
    anchor = main.scan_frame if scan is not None and main.scan_frame in main.frames else main.frames[0]
    report.step(f"fitting the body to frame {anchor} of {main.name}")
    observation = replace(_look(main, anchor, _CONTOUR_POINTS), scan=with_scan([], scan).scan)
    start = _start(body, main, anchor, observation, scan, report, effort)
    states = _all_frames(body, main, anchor, start, report)
    report.step("fitting one shape to several frames")
    state = _one_shape(body, main, anchor, states, observation, effort)
    poses: dict[str, Poses] = {}
    misfits: dict[str, float] = {}
    checks: dict[str, Any] = {}
    for take in takes:
        if take is not main:
            observation = _look(take, take.frames[0], _CONTOUR_POINTS)
            start = _start(body, take, take.frames[0], observation, None, report, effort)
            states = _all_frames(body, take, take.frames[0], start, report)
        report.step(f"polishing {take.name}")
        check = FitCheck(take)
        poses[take.name], misfits[take.name] = _polished(body, take, states, state.betas, check, report)
        checks[take.name] = check.judge(state.betas, report)
    content = {"misfit_m": misfits, "shape_from_frames": _spread(main.frames), "checks": checks}
    return TakesFit(poses, content)


def _start(
    body: BodyModel,
    take: Take,
    frame: int,
    observation: Observation,
    scan: Mesh | None,
    report: Report,
    effort: float,
) -> State:
    """Parameters of one frame: refined from the capture's pose, or fitted to the scan, landmarks or masks."""
    if take.posed:
        state = State.of(take.poses[frame])
        return refine(body, state, [observation], _TOGETHER, effort, shape=True)
    if scan is not None:
        state = fit_scan(body, scan, report, effort).state
        return refine(body, state, [observation], _TOGETHER[1:], effort, shape=True)
    if observation.landmarks is not None and observation.landmarks.enough(body):
        return _best_of_hypotheses(body, take, frame, observation, report, effort)
    return first_pose(body, rough_hull(take, frame, report), observation, report, effort)


def _best_of_hypotheses(
    body: BodyModel, take: Take, frame: int, observation: Observation, report: Report, effort: float
) -> State:
    """The fit that starts from the landmarks; if it ends far from them, the better of it and the hull's."""
    state = pose_from_landmarks(body, observation, effort)
    if not wrong_parts(body, state, 0, observation):
        return state
    other = first_pose(body, rough_hull(take, frame, report), observation, report, effort)

    def cost(one: State) -> float:
        return misfit_of(body, one, observation) + landmark_misfit(body, one, 0, observation)

    return min((state, other), key=cost)


def _all_frames(body: BodyModel, take: Take, anchor: int, start: State, report: Report) -> dict[int, State]:
    """States of all frames: the capture's poses with the shape of `start`, or tracked from the anchor."""
    if take.posed:
        return {
            frame: replace(State.of(take.poses[frame]), betas=start.betas.copy()) for frame in take.frames
        }
    report.step(f"following the body through {take.name}")
    later = [frame for frame in take.frames if frame > anchor]
    earlier = [frame for frame in reversed(take.frames) if frame < anchor]
    lazily = _Views(take)
    states = {anchor: start}
    for frames in (later, earlier):
        states |= track(body, start, frames, lazily, report)
    return states


def _one_shape(
    body: BodyModel,
    take: Take,
    anchor: int,
    states: Mapping[int, State],
    observation: Observation,
    effort: float,
) -> State:
    """Frames spread over the take, improved together with the shape they share."""
    frames = sorted({anchor, *_spread(take.frames)})
    together = [observation if frame == anchor else _look(take, frame, _CONTOUR_POINTS) for frame in frames]
    state = concatenate_states([states[frame] for frame in frames])
    state.betas = states[anchor].betas.copy()
    return refine(body, state, together, _TOGETHER, effort, shape=True)


def _polished(
    body: BodyModel,
    take: Take,
    states: Mapping[int, State],
    betas: np.ndarray,
    check: FitCheck,
    report: Report,
) -> tuple[Poses, float]:
    """Poses of all frames with the shape that all share, and the median misfit of their contours, metres.

    Frames that were not captured repeat the one before them.
    """
    polished: dict[int, State] = {}
    misfits: dict[int, float] = {}
    lazily = _Views(take)
    for number, frame in enumerate(take.frames):
        state = with_shape(body, states[frame], betas)
        polished[frame] = refine(body, state, [lazily[frame]], _POLISH, 1.0, shape=False)
        misfits[frame] = misfit_of(body, polished[frame], lazily[frame])
        check.add(body, frame, polished[frame], lazily[frame])
        report.progress(number + 1, len(take.frames))
    usual = float(np.median(list(misfits.values())))
    lost = [frame for frame, value in misfits.items() if value > _LOST_TIMES * usual + _LOST_M]
    if lost:
        report.warn(f"{take.name}: the body fits {len(lost)} frames badly, the first is {lost[0]}")
    rows = np.searchsorted(take.frames, np.arange(max(take.frames) + 1), side="right") - 1
    order = [polished[take.frames[max(row, 0)]] for row in rows]
    state = concatenate_states(order)
    state.betas = np.asarray(betas, np.float64)
    return state.poses(take.fps), usual


def with_shape(body: BodyModel, state: State, betas: np.ndarray) -> State:
    """The same one-frame pose with another shape, its joints where they were on average."""
    before = bones_of(body, state).joints[:22].mean(axis=0)
    changed = replace(state, betas=np.asarray(betas, np.float64).copy(), translation=state.translation.copy())
    changed.translation[0] += before - bones_of(body, changed).joints[:22].mean(axis=0)
    return changed


def _look(take: Take, frame: int, contour_points: int) -> Observation:
    """The masks of a frame, and its landmarks where the take has some."""
    landmarks = take_landmarks(take)
    points = None if landmarks is None else landmarks.at(frame)
    targets = None if points is None or not np.isfinite(points).any() else Targets(points)
    return Observation(views_of(take, frame, contour_points), landmarks=targets)


class _Views(dict[int, Observation]):
    """Masks of frames, read when asked for; only the last frame is kept."""

    def __init__(self, take: Take) -> None:
        super().__init__()
        self._take = take

    def __missing__(self, frame: int) -> Observation:
        self.clear()
        self[frame] = _look(self._take, frame, _CONTOUR_POINTS_TRACKED)
        return self[frame]


def _spread(frames: Sequence[int]) -> list[int]:
    rows = np.unique(np.linspace(0, len(frames) - 1, _SHAPE_FRAMES).astype(int))
    return [frames[row] for row in rows]
