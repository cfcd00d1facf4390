"""Several training takes as one film: numbers, poses, motion, cameras; tracking from take to take."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.pipeline import PIPELINE, TRAIN
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.staleness import staleness
from stages.shared.avatar.pose import recent_motion
from stages.shared.body import Poses, embedded_body, posed_joints
from stages.shared.capture import Capture, open_capture
from stages.shared.errors import BadData, UsageProblem
from stages.train import stage
from stages.train.config import TrackConfig
from stages.train.take_sequence import concatenate_takes
from stages.train.tracking.tracker import plan_route
from tests.stages.train.scene import FRAMES, make_subject, poses, tiny

_TURNED = 3


def _turning() -> Poses:
    """A second motion: the whole person turns, bent to one side."""
    rotations = np.zeros((_TURNED, 55, 3), np.float32)
    rotations[:, 0, 1] = np.linspace(0.0, 0.8, _TURNED)
    rotations[:, 3, 2] = 0.4
    translation = np.zeros((_TURNED, 3), np.float32)
    translation[:, 0] = 0.02
    return Poses(rotations, translation, np.zeros(10, np.float32), np.zeros((_TURNED, 10), np.float32))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("takes"), others={"turns": _turning()}).parent


@pytest.fixture
def subject(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared, tmp_path / "copy")
    return tmp_path / "copy" / "subject"


@pytest.fixture
def capture(prepared: Path) -> Capture:
    return open_capture(prepared / "capture")


def test_frames_of_both_takes_show_their_own_pictures_poses_and_motion(
    subject: Path, capture: Capture
) -> None:
    model = replace(tiny().model, history=2)
    trainer = stage.prepare(subject, tiny(takes=("turns",), model=model))
    views, second = trainer.views, capture.take("turns")
    assert len(trainer.frames) == FRAMES + _TURNED and trainer.frames[:FRAMES] == list(range(FRAMES))
    for own, frame in enumerate(trainer.frames[FRAMES:]):
        view = views.view(frame, "cam1")
        left, top, right, bottom = second.subject_box("cam1", own, margin=8) or (0, 0, 0, 0)
        expected = second.image("cam1", own)[top:bottom, left:right] / 255.0
        assert np.allclose(view.image.numpy(), expected)
        assert np.array_equal(views.poses.rotations[frame], _turning().rotations[own])
        assert torch.allclose(
            recent_motion(views.poses, frame, 3), recent_motion(_turning(), own, 3), atol=1e-6
        )
        assert trainer.pose(frame).motion is not None
    assert recent_motion(views.poses, trainer.frames[-1], 3)[3:].abs().max() > 0.1
    seen = {trainer.step(number, 0.0).frame for number in range(FRAMES + _TURNED)}
    assert seen == set(trainer.frames)


def test_a_run_says_which_takes_it_learned_from_and_the_usual_one_is_as_before(
    subject: Path, tmp_path: Path
) -> None:
    alone = stage.run(subject, tiny(steps=2))
    assert alone.summary["frames"] == FRAMES and "takes" not in alone.summary
    assert "takes" not in alone.artifact.config and "capture/poses" not in alone.artifact.manifest.inputs
    both = stage.run(subject, tiny(steps=2, takes=("all",)))
    assert both.summary["takes"] == ["moves", "turns"] and both.summary["frames"] == FRAMES + _TURNED
    assert both.artifact.key != alone.artifact.key
    assert _state(subject) == ("up to date", [])
    pose_file = subject.parent / "capture" / "takes" / "turns" / "smpl_params.npz"
    moved = _turning()
    pose_file.write_bytes(replace(moved, translation=moved.translation + np.float32(0.01)).to_npz_bytes())
    state, reasons = _state(subject)
    assert state == "stale" and any("turns/smpl_params.npz changed" in reason for reason in reasons)


def _state(subject: Path) -> tuple[str, list[str]]:
    found = next(one for one in staleness(Workspace(subject), PIPELINE) if one.stage == "train")
    return found.state, found.reasons


def test_takes_that_do_not_go_together_are_refused(subject: Path, capture: Capture) -> None:
    with pytest.raises(UsageProblem, match="no training take 'walks'"):
        stage.run(subject, tiny(takes=("walks",)))
    body, takes = embedded_body(), (capture.take("moves"), capture.take("turns"))
    motions = [take.poses for take in takes]
    with pytest.raises(UsageProblem, match="frames per second"):
        concatenate_takes(takes, [motions[0], replace(motions[1], fps=12.5)], body)
    lonely = replace(takes[1], training_cameras=("cam2",))
    with pytest.raises(UsageProblem, match="no training camera in common"):
        concatenate_takes((takes[0], lonely), motions, body)
    with pytest.raises(BadData, match="2 poses"):
        concatenate_takes(takes, [motions[0], motions[1][:2]], body)
    held = replace(takes[1], split="test")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "stages.train.source.open_subject_capture",
            lambda *_: replace(capture, takes=(takes[0], held)),
        )
        with pytest.raises(UsageProblem, match="held out for tests"):
            stage.run(subject, tiny(takes=("turns",)))
    assert Workspace(subject).current(TRAIN) is None


def test_cameras_may_stand_elsewhere_in_another_take(capture: Capture) -> None:
    first, second = capture.take("moves"), capture.take("turns")
    moved = np.array(second.camera("cam0").camera_from_world)
    moved[0, 3] += 0.1
    cameras = {**second.cameras, "cam0": replace(second.camera("cam0"), camera_from_world=moved)}
    sequence, _ = concatenate_takes(
        (first, replace(second, cameras=cameras)), [first.poses, second.poses], embedded_body()
    )
    start = sequence.starts[1]
    assert np.allclose(sequence.camera("cam0", 1).centre, first.camera("cam0").centre)
    assert not np.allclose(sequence.camera("cam0", start + 1).centre, first.camera("cam0").centre)
    assert sequence.training_cameras == ("cam0", "cam1") and sequence.heldout_cameras == ("cam2",)
    assert sequence.every(2) == [0, 2, start, start + 2]
    assert sequence.groups(sequence.every(2)) == [[0, 1], [2, 3]]


def test_a_body_fitted_with_another_shape_keeps_the_place_of_its_pelvis(capture: Capture) -> None:
    body, takes = embedded_body(), (capture.take("moves"), capture.take("turns"))
    tall = np.zeros(10, np.float32)
    tall[0] = 3.0
    other = replace(_turning(), betas=tall)
    sequence, rows = concatenate_takes(takes, [poses(), other], body)
    for own in range(_TURNED):
        found = [
            posed_joints(
                body, *(torch.from_numpy(a) for a in (p.rotations[row], p.translation[row], p.betas))
            )
            for p, row in ((rows, sequence.starts[1] + own), (other, own))
        ]
        assert torch.allclose(found[0][0], found[1][0], atol=1e-5)
        assert not torch.allclose(found[0][15], found[1][15], atol=1e-2), (
            "the head of a taller body is higher"
        )


def test_one_take_is_followed_forwards_then_backwards() -> None:
    route = plan_route([[0, 1, 2, 3, 4]], 2, torch.zeros(5, 3))
    assert route.order == [2, 3, 4, 1, 0]
    assert route.before == {2: None, 3: 2, 4: 3, 1: 2, 0: 1}
    assert [route.earlier(index) for index in route.order] == [None, None, 2, None, 2]


def test_another_take_is_entered_where_its_pose_is_nearest_to_a_known_one() -> None:
    described = torch.tensor([0.0, 1.0, 2.0, 9.0, 1.1, 7.0, 0.9])[:, None]
    route = plan_route([[0, 1, 2], [3, 4, 5, 6]], 0, described)
    assert route.order[:3] == [0, 1, 2] and sorted(route.order) == list(range(7))
    entry = route.order[3]
    assert entry in (4, 6) and route.before[entry] == 1
    assert route.entries == {0, entry} and route.earlier(entry) is None
    place = {index: number for number, index in enumerate(route.order)}
    assert all(last is None or place[last] < place[index] for index, last in route.before.items())


def test_tracking_follows_every_frame_of_every_take(subject: Path) -> None:
    config = tiny(takes=("all",), track=TrackConfig(frame_step=1, cell=8, warm_up=1, rounds=1))
    trainer = stage.prepare(subject, config)
    assert trainer.tracker is not None
    trainer.warm_up()
    for place in range(len(trainer.tracker.order)):
        trainer.tracker.follow(place)
    found = trainer.tracker.tracked["upper"].control_points
    assert len(found) == FRAMES + _TURNED == len(trainer.key_frames)
    assert bool((found.abs().amax(dim=(1, 2)) > 0).all())
    entered = trainer.tracker.order[FRAMES]
    assert trainer.tracker.route.before[entered] == FRAMES - 1, "both are bent to the same side"
