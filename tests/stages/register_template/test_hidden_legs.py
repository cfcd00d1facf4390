"""A person in a long skirt with hanging arms: the fit is right, and a poor frame of the template is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.register_template.config import PRESETS, RegisterTemplateConfig
from stages.register_template.fitting.body_parts import parts_far_from
from stages.register_template.fitting.bones import State, bones_of
from stages.register_template.from_capture import register_capture
from stages.register_template.sources import Registration, SourceFiles, open_source
from stages.shared.body import Poses, embedded_body
from stages.shared.body.posed import posed_body
from stages.shared.meshes.mesh import Mesh
from tests.listening import Listener

from .scenes import skirted_pose, write_skirted

BODY = embedded_body()


def registered(folder: Path, poses: Poses) -> tuple[Registration, list[str]]:
    """The fit of a captured person in a skirt, at the smallest preset, and its warnings."""
    heard = Listener()
    config = RegisterTemplateConfig(**{**vars(PRESETS["tiny"]), "poses": "fit"})
    source = open_source(SourceFiles(write_skirted(folder, poses)), config)
    return register_capture(source, config, heard), heard.warnings


def test_limbs_follow_landmarks_and_the_more_open_frame_is_named(tmp_path: Path) -> None:
    truth = skirted_pose((1.45, 1.0))
    result, warnings = registered(tmp_path / "capture", truth)
    for frame in (0, 1):
        found = bones_of(BODY, State.of(result.poses[frame])).joints[:22]
        away = np.linalg.norm(found - bones_of(BODY, State.of(truth[frame])).joints[:22], axis=1)
        assert away.max() < 0.04
    assert np.abs(result.poses.betas).max() < 2
    assert result.frame == 1, warnings


def test_hanging_arms_are_said_when_there_is_no_better_frame(tmp_path: Path) -> None:
    _, warnings = registered(tmp_path / "capture", skirted_pose((1.45,)))
    assert any("their surfaces are one; take or record a frame" in text for text in warnings)


def test_a_head_away_from_the_surface_is_named() -> None:
    posed = posed_body(BODY, skirted_pose((1.0,))[0])
    assert parts_far_from(Mesh(posed, BODY.faces), posed, BODY) == []
    turned = skirted_pose((1.0,))
    turned.rotations[0, [9, 12], 2] = 0.7
    assert parts_far_from(Mesh(posed, BODY.faces), posed_body(BODY, turned[0]), BODY)[0] == "head"
