"""What a configuration becomes for a given capture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from stages.train import stage
from stages.train.config import PRESETS
from stages.train.resolve import frame_step_by_time, resolve, resolve_settings
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
