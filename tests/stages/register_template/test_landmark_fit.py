"""Landmarks in a fit: where they are on the body, the pose they give, and wrong fits that they reveal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.fitting.bones import State, bones_of
from stages.register_template.fitting.contours import views_of
from stages.register_template.fitting.fit_check import (
    FitCheck,
    crossed_legs,
    faults,
    landmark_misfit,
    unusual_betas,
    wrong_parts,
)
from stages.register_template.fitting.fit_views import Observation
from stages.register_template.fitting.landmark_terms import (
    Targets,
    first_state,
    landmark_distances,
    landmark_points,
    landmark_residuals,
)
from stages.register_template.fitting.prior import SHAPE_LIMIT, Prior
from stages.register_template.from_capture import alignment_bar
from stages.shared.body import embedded_body
from stages.shared.body.skeleton import JOINT_INDEX
from stages.shared.capture import open_capture
from stages.shared.capture.landmarks import Landmarks, read_landmarks
from stages.shared.capture.take import Take
from stages.shared.errors import BadData
from tests.listening import Listener

from .scenes import a_pose, write_capture

BODY = embedded_body()


def standing(frame: int = 1) -> State:
    state = State.of(a_pose())
    one = state.frame(frame)
    one.rotations[0, 0] = [0.0, 2.0, 0.0]
    one.rotations[0, JOINT_INDEX["right_knee"], 0] = 0.6
    one.rotations[0, JOINT_INDEX["left_elbow"], 1] = -0.5
    return one


def targets_of(state: State) -> Targets:
    numbers, points, _ = landmark_points(BODY)
    positions = np.full((33, 3), np.nan)
    positions[numbers] = bones_of(BODY, state).positions(points)
    return Targets(positions)


def take() -> Take:
    return Take("walk", "train", {}, (), (), [0], a_pose(1), {})


def test_vertices_that_stand_for_landmarks_are_where_they_should_be() -> None:
    numbers, points, _ = landmark_points(BODY)
    place = dict(zip(numbers.tolist(), points.rest, strict=True))
    head = BODY.joint_template[JOINT_INDEX["head"]]
    assert place[0][2] > head[2] + 0.06 and abs(place[0][0]) < 0.01  # the nose
    assert place[7][0] > 0.05 and place[8][0] < -0.05 and place[7][2] < place[0][2] - 0.04  # the ears
    for heel, toe, side in ((29, 31, 1), (30, 32, -1)):
        assert place[toe][2] > place[heel][2] + 0.18 and side * place[toe][0] > 0
        assert max(place[heel][1], place[toe][1]) < BODY.template_vertices[:, 1].min() + 0.06


def test_landmarks_alone_give_the_pose() -> None:
    truth = standing()
    found = first_state(BODY, targets_of(truth))
    apart = np.linalg.norm(bones_of(BODY, found).joints - bones_of(BODY, truth).joints, axis=1)
    assert apart[:22].max() < 0.06 and np.median(apart[:22]) < 0.025


def test_residuals_are_distances_and_their_slopes_finite_differences() -> None:
    state, targets = standing(), targets_of(standing(0))
    one = landmark_residuals(BODY, state, 0, targets, 4)
    joints = np.arange(22)
    rows = bones_of(BODY, state).jacobian(one.points, one.gradients, joints)
    moved = state.copy()
    moved.translation[0, 1] += 1e-4
    after = landmark_residuals(BODY, moved, 0, targets, 4)
    np.testing.assert_allclose((after.values - one.values) / 1e-4, rows[:, 1], atol=1e-3)
    known = targets.known.sum()
    assert len(one.values) == 3 * known
    hidden = Targets(np.where(np.arange(33)[:, None] == 15, np.nan, targets.points))
    assert len(landmark_residuals(BODY, state, 0, hidden, 4).values) == 3 * (known - 1)


def test_crossed_legs_are_recognised() -> None:
    """The silhouette of hanging arms and a skirt allows them; the landmarks do not."""
    truth = standing()
    wrong = truth.copy()
    wrong.rotations[0, JOINT_INDEX["left_hip"], 2] -= 0.5
    wrong.rotations[0, JOINT_INDEX["right_hip"], 2] += 0.5
    observation = Observation([], landmarks=targets_of(truth))
    assert wrong_parts(BODY, truth, 0, observation) == []
    assert {"feet", "knees"} <= set(wrong_parts(BODY, wrong, 0, observation))
    assert landmark_misfit(BODY, wrong, 0, observation) > 0.1 > landmark_misfit(BODY, truth, 0, observation)
    heard, check = Listener(), FitCheck(take())
    check.add(BODY, 0, wrong, observation)
    with pytest.raises(BadData, match="does not fit"):
        check.judge(wrong.betas, heard)
    assert any("feet" in text for text in heard.warnings)
    assert any("the legs are crossed in 1 of 1 frames" in text for text in heard.warnings)
    assert crossed_legs(BODY, wrong) and not crossed_legs(BODY, truth)
    assert faults(BODY, truth, observation) == []


def test_a_head_beside_the_head_is_named_without_landmarks(tmp_path: Path) -> None:
    """Most of the body is inside of the masks; the head is not."""
    capture = open_capture(write_capture(tmp_path / "capture"))
    observation = Observation(views_of(capture.takes[0], 1))
    truth = State.of(a_pose()[1])
    assert faults(BODY, truth, observation) == []
    wrong = truth.copy()
    wrong.rotations[0, [JOINT_INDEX["spine3"], JOINT_INDEX["neck"]], 2] += 0.7
    assert "the head is outside of the masks" in faults(BODY, wrong, observation)


def test_a_shape_that_few_people_have_is_unusual_though_no_beta_is() -> None:
    assert unusual_betas(np.full(10, 2.0)) == ["2.0 standard deviations"]
    assert unusual_betas(np.r_[2.0, np.zeros(9)]) == []


def test_an_unusual_shape_is_said_and_a_usual_one_is_not() -> None:
    check, heard = FitCheck(take()), Listener()
    numbers = check.judge(np.r_[-6.7, np.zeros(9)], heard)
    assert "β0 -6.7" in heard.warnings[0] and numbers["unusual_betas"] == ["β0 -6.7"]
    check.judge(np.full(10, 1.5), heard)
    assert len(heard.warnings) == 1


def test_no_beta_leaves_its_spread() -> None:
    betas = np.r_[SHAPE_LIMIT + 0.5, -SHAPE_LIMIT - 0.5, 1.0, np.zeros(7)]
    hessian, slope = Prior().shape(betas)
    np.testing.assert_allclose(slope[:2] / hessian[:2], [0.5, -0.5], rtol=1e-4)
    assert slope[2] == pytest.approx(1.0)


def test_landmark_files(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    points = random.normal(size=(2, 33, 3)).astype(np.float32)
    points[1, 4] = np.nan
    landmarks = Landmarks(
        ("a", "b"),
        np.array([3, 5]),
        random.normal(size=(2, 2, 33, 2)).astype(np.float32),
        random.random((2, 2, 33)).astype(np.float32),
        points,
        np.full((2, 33), 2, np.int32),
    )
    (tmp_path / "landmarks.npz").write_bytes(landmarks.encoded())
    read = read_landmarks(tmp_path / "landmarks.npz")
    assert read.cameras == ("a", "b") and read.at(4) is None
    np.testing.assert_array_equal(read.at(5), points[1].astype(np.float64))
    wrong = replace(landmarks, points=points[:1])
    (tmp_path / "landmarks.npz").write_bytes(wrong.encoded())
    with pytest.raises(BadData, match="points has the shape"):
        read_landmarks(tmp_path / "landmarks.npz")


def test_distances_of_unknown_parts_are_unknown() -> None:
    truth = standing()
    targets = targets_of(truth)
    targets.points[[0, 7, 8]] = np.nan
    numbers = landmark_distances(BODY, truth, 0, targets)
    assert np.isnan(numbers["head"]) and numbers["hands"] == pytest.approx(0, abs=1e-9)
    assert targets.enough(BODY)
    targets.points[11] = np.nan
    assert not targets.enough(BODY)


def test_less_is_asked_of_a_fitted_body_than_of_given_poses() -> None:
    config = RegisterTemplateConfig(bar=0.9)
    assert alignment_bar(config, fitted=False) == 0.9 > alignment_bar(config, fitted=True)
    assert alignment_bar(replace(config, bar=0.5), fitted=True) == 0.5
