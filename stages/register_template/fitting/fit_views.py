"""Fit the body to images: a hull of the masks gives the pose, contours refine it, and frames follow in time.

Frames of all takes share one shape. The first frame is fitted from many initial guesses, like a scan. Every
other frame starts from the one before it. A few frames, spread over the motion, then refine the shape.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stages.register_template.fitting.bones import State, SurfacePoints, bones_of, vertices_of
from stages.register_template.fitting.contours import View
from stages.register_template.fitting.fit_scan import ALL_BETAS, BODY_JOINTS, LEVELS, Level, fit_scan
from stages.register_template.fitting.landmark_terms import (
    Targets,
    first_state,
    landmark_distances,
    landmark_residuals,
)
from stages.register_template.fitting.prior import Prior
from stages.register_template.fitting.scan_terms import (
    ScanPoints,
    from_body,
    from_scan,
    outer_points,
    scan_points,
)
from stages.register_template.fitting.solve import ActiveParameters, Residuals, step
from stages.register_template.fitting.view_terms import contour_distance, outside_of_mask, view_misfit
from stages.shared.body import BodyModel
from stages.shared.body.skeleton import JOINT_COUNT
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.topology import face_normals
from stages.shared.report import Report

_OUTER_POINTS = 800
_ROUNDS = ((0.10, 8, 0.3), (0.05, 10, 0.1), (0.025, 12, 0.03))  # robust distance (m), steps, smallest contact
_TRACK = ((0.08, 4, 0.2), (0.03, 5, 0.05))
_SCAN_ROUND = LEVELS[-2]
_NEAR_SPREAD = np.radians(20.0)  # that a joint turns between two frames
_MISFIT_M = 0.10
_LOST_PART_M = 0.10
# Errors of a mask are correlated along its contour: a view constrains the shape less than its points would.
_SHAPE_WEIGHT = 15.0
_NO_BETAS = np.arange(0)


@dataclass(frozen=True, eq=False)
class Observation:
    """What one frame shows: its masks, and a scan or landmarks if there are any."""

    views: Sequence[View]
    scan: ScanPoints | None = None
    landmarks: Targets | None = None


def first_pose(
    body: BodyModel,
    hull: Mesh,
    observation: Observation,
    report: Report,
    effort: float = 1.0,
    levels: tuple[Level, ...] = LEVELS[:3],
) -> State:
    """One frame from nothing: the hull of its masks as a rough scan, then contours (and the scan)."""
    rough = fit_scan(body, hull, report, effort, levels=levels)
    return refine(body, rough.state, [observation], _ROUNDS, effort, shape=True)


def pose_from_landmarks(body: BodyModel, observation: Observation, effort: float = 1.0) -> State:
    """One frame that starts from its landmarks and ends at its contours."""
    assert observation.landmarks is not None
    return refine(
        body, first_state(body, observation.landmarks), [observation], _ROUNDS[1:], effort, shape=True
    )


def track(
    body: BodyModel,
    start: State,
    frames: Sequence[int],
    observations: Mapping[int, Observation],
    report: Report,
) -> dict[int, State]:
    """One-frame states of `frames`, which follow each other in time, with the shape of `start`."""
    states: dict[int, State] = {}
    before, earlier = start, None
    for number, frame in enumerate(frames):
        guess = before.copy()
        if earlier is not None:
            guess.translation = guess.translation + 0.5 * (before.translation - earlier.translation)
        prior = Prior(near=before.rotations, near_spread=np.full(JOINT_COUNT, _NEAR_SPREAD))
        states[frame] = refine(body, guess, [observations[frame]], _TRACK, 1.0, shape=False, prior=prior)
        states[frame] = _recovered(body, states[frame], observations[frame])
        before, earlier = states[frame], before
        report.progress(number + 1, len(frames))
    return states


def _recovered(body: BodyModel, state: State, observation: Observation) -> State:
    """The tracked frame, or a fit that starts from its landmarks where tracking lost a part of the body."""
    targets = observation.landmarks
    if targets is None or not targets.enough(body):
        return state
    lost = _farthest_part(body, state, targets)
    if lost <= _LOST_PART_M:
        return state
    again = first_state(body, targets, state.betas)
    again = refine(body, again, [observation], _TRACK[1:], 1.0, shape=False)
    return again if _farthest_part(body, again, targets) < lost else state


def _farthest_part(body: BodyModel, state: State, targets: Targets) -> float:
    """Metres between landmarks and the part of the body that is farthest from them."""
    return float(np.nanmax(list(landmark_distances(body, state, 0, targets).values())))


def refine(
    body: BodyModel,
    state: State,
    observations: Sequence[Observation],
    rounds: Sequence[tuple[float, int, float]],
    effort: float,
    shape: bool,
    prior: Prior | None = None,
) -> State:
    """Improve the frames of a state together by their contours and scans.

    Arguments:
        observations: of every frame of `state`.
        rounds: robust distance (metres), steps and smallest contact of each.
        shape: whether the betas move, too.
    """
    outer = outer_points(body, _OUTER_POINTS)
    active = ActiveParameters(BODY_JOINTS, ALL_BETAS if shape else _NO_BETAS)
    views = sum(len(one.views) for one in observations)
    prior = prior or Prior(shape_weight=max(1.0, _SHAPE_WEIGHT * views))
    for robust, steps, least_contact in rounds:
        for _ in range(max(2, round(effort * steps))):
            bones = [bones_of(body, state, number) for number in range(len(observations))]
            terms = [
                _terms(
                    body,
                    vertices_of(body, state, number),
                    outer,
                    bones[number].positions(outer),
                    one,
                    robust,
                    least_contact,
                    state,
                    number,
                )
                for number, one in enumerate(observations)
            ]
            state = step(state, bones, terms, prior, active)
    return state


def misfit_of(body: BodyModel, state: State, observation: Observation) -> float:
    """Root of the mean squared robust distance of one frame's contours, metres."""
    outer = outer_points(body, _OUTER_POINTS)
    positions = bones_of(body, state).positions(outer)
    return float(
        np.sqrt(view_misfit(body, vertices_of(body, state), positions, list(observation.views), _MISFIT_M))
    )


def with_scan(views: Sequence[View], scan: Mesh | None) -> Observation:
    """A frame that has masks and perhaps a scan in metres."""
    return Observation(views, None if scan is None else scan_points(scan, _SCAN_ROUND.points))


def concatenate_states(states: Sequence[State]) -> State:
    """One-frame states as one state, with the mean of their shapes."""
    return State(
        np.concatenate([one.rotations for one in states]),
        np.concatenate([one.translation for one in states]),
        np.mean([one.betas for one in states], axis=0),
    )


def _terms(
    body: BodyModel,
    vertices: np.ndarray,
    outer: SurfacePoints,
    positions: np.ndarray,
    observation: Observation,
    robust: float,
    least_contact: float,
    state: State,
    frame: int,
) -> list[Residuals]:
    terms, normals = [], face_normals(vertices, body.faces)[0]
    for view in observation.views:
        terms.append(outside_of_mask(outer, positions, view, robust))
        terms.append(contour_distance(body, vertices, normals, view, robust, least_contact))
    if observation.scan is not None:
        contact = observation.scan.contact_at_least(least_contact)
        near = min(robust, _SCAN_ROUND.robust)
        terms += [from_scan(body, vertices, contact, near), from_body(outer, positions, contact, near)]
    if observation.landmarks is not None:
        terms.append(landmark_residuals(body, state, frame, observation.landmarks, len(observation.views)))
    return [one for one in terms if len(one.values)]
