"""What a configuration becomes for a given capture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from stages.train import stage
from stages.train.config import PRESETS
from stages.train.resolve import frame_step_by_time, resolve, resolve_settings, scale_by_texel
from tests.stages.train.scene import make_subject, tiny


@pytest.mark.parametrize(
    ("fps", "frames", "learned"), [(6, 40, 40), (12, 80, 40), (30, 200, 40), (120, 800, 40)]
)
def test_seven_seconds_give_forty_frames_at_any_rate(fps: float, frames: int, learned: int) -> None:
    assert len(range(0, frames, frame_step_by_time(frames, fps))) == learned


def test_short_takes_give_all_their_frames_and_long_ones_two_a_second() -> None:
    assert frame_step_by_time(1, 30) == frame_step_by_time(39, 120) == frame_step_by_time(79, 30) == 1
    assert frame_step_by_time(18_000, 30) == 15
    assert frame_step_by_time(1_000, 1) == 1, "half a second is less than a frame"


def test_presets_by_time_learn_from_every_frame_of_a_short_take_and_say_so(tmp_path: Path) -> None:
    subject = make_subject(tmp_path)
    config = replace(PRESETS["tiny"], steps=1)
    assert config.frame_step == 0 and stage.plan(subject, config).config["frame_step"] == 1
    result = stage.run(subject, config)
    assert result.summary["frames"] == 4 and result.summary["frame_step"] == 1
    json.dumps(result.summary)
    assert stage.run(subject, replace(config, frame_step=2)).summary["frames"] == 2


def test_resolving_settings_twice_changes_nothing_more() -> None:
    for config in PRESETS.values():
        once = resolve_settings(config)
        assert resolve_settings(once) == once


def test_key_poses_are_the_tracked_frames(tmp_path: Path) -> None:
    from stages.shared.artifacts import Workspace
    from stages.train.source import open_source

    config = tiny(frame_step=1, track=replace(tiny().track, frame_step=2))
    source = open_source(Workspace(make_subject(tmp_path)), config)
    assert resolve(config, source).model.anchors == 2
    assert resolve(replace(config, track=replace(config.track, frame_step=0)), source).model.anchors == 3


def test_pictures_are_scaled_until_a_texel_covers_two_and_a_half_pixels() -> None:
    pixels_per_texel = 8000 * 0.004 / 3.0
    assert scale_by_texel(8000, 3.0, 0.004) * pixels_per_texel == pytest.approx(2.5)
    assert scale_by_texel(500, 3.0, 0.004) == 1.0, "a texel is smaller than a pixel"
    assert scale_by_texel(8000, 3.0, 0.002) == pytest.approx(2 * scale_by_texel(8000, 3.0, 0.004))


def test_tracking_sees_pictures_of_the_resolved_scale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from stages.train.views import TrainingViews

    subject, sizes, view = make_subject(tmp_path), set(), TrainingViews.view

    def noted(self: TrainingViews, frame: int, camera: str, scale: float = 1.0, *rest: object) -> object:
        sizes.add(scale)
        return view(self, frame, camera, scale, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(TrainingViews, "view", noted)
    track = replace(tiny().track, frame_step=1, cell=8, warm_up=1, rounds=1)
    for scale, expected in ((0.0, 1.0), (0.75, 0.75)):
        trainer = stage.prepare(subject, tiny(track=replace(track, scale=scale)))
        assert trainer.config.track.scale == expected
        sizes.clear()
        trainer.warm_up()
        assert trainer.tracker is not None
        trainer.tracker.follow(0)
        assert sizes == {expected}


def test_a_late_run_carries_offsets_on_instead_of_tracking(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from stages.train import loop
    from tests.listening import Listener

    subject, listener = make_subject(tmp_path), Listener()
    monkeypatch.setattr(loop, "_is_late", lambda config, state: state.tracked >= 2)
    track = replace(tiny().track, frame_step=1, cell=8, warm_up=1, rounds=1)
    config = tiny(steps=1, track=track, rates=replace(tiny().rates, anchors=0.0))
    offsets = stage.run(subject, config, listener).artifact.arrays("upper")["anchors.offsets"]
    assert any(
        "2 of 4 frames start with the offsets of the frame before" in text for text in listener.warnings
    )
    assert (offsets[1] == offsets[2]).all() and (offsets[2] == offsets[3]).all()
    assert (offsets[0] != offsets[1]).any()
