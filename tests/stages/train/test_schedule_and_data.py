"""Order of frames and cameras, schedules, crops and outlines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.shared.body import embedded_body
from stages.shared.capture import Camera, open_capture
from stages.shared.capture.exposure import Exposure
from stages.shared.losses.picture import rasterize_silhouette
from stages.train import schedule
from stages.train.config import PRESETS, LossWeights, TrainConfig
from stages.train.take_sequence import TakeSequence
from stages.train.views import TrainingViews, choose
from tests.stages.train.scene import make_subject, poses, tiny


def test_every_frame_once_per_epoch_and_no_camera_twice() -> None:
    frames, cameras = list(range(0, 50, 5)), ["a", "b", "c", "d"]
    epochs = [[choose(3, 10 * e + s, frames, cameras, 2).frame for s in range(10)] for e in range(3)]
    assert all(sorted(epoch) == frames for epoch in epochs)
    assert epochs[0] != epochs[1]
    for step in range(20):
        chosen = choose(3, step, frames, cameras, 3)
        assert len(set(chosen.cameras)) == 3
        again = choose(3, step, frames, cameras, 3)
        assert chosen.cameras == again.cameras and np.array_equal(chosen.backgrounds, again.backgrounds)
    assert len(choose(3, 0, frames, cameras, 9).cameras) == 4


def test_schedules_run_from_start_to_end() -> None:
    config = TrainConfig(steps=100, rate_end=0.05, coarse_scale=0.5, coarse_until=0.3, stage_two=0.5)
    assert schedule.rate_factor(config, 0.0) == pytest.approx(1.0)
    assert schedule.rate_factor(config, 1.0) == pytest.approx(0.05)
    scales = [schedule.image_scale(config, done) for done in np.linspace(0, 1, 50)]
    assert scales[0] == pytest.approx(0.5) and scales[-1] == 1.0 and scales == sorted(scales)
    assert schedule.stage_weights(config, 0.49).penetration == 0
    assert schedule.stage_weights(config, 0.5) == config.weights
    guided = replace(config, weights=LossWeights(flow=1.0), flow_until=0.6)
    assert schedule.stage_weights(guided, 0.5).flow == 1.0 and schedule.stage_weights(guided, 0.6).flow == 0.0
    assert schedule.progress(config, 10, 0.0) == 0.1
    timed = TrainConfig(steps=100, minutes=1.0)
    assert schedule.progress(timed, 10, 30.0) == 0.5


def test_paper_preset_holds_the_published_values() -> None:
    paper = PRESETS["paper"]
    assert paper.weights == LossWeights(
        l1=1.0,
        ssim=0.05,
        label=0.5,
        silhouette=0.05,
        penetration=0.5,
        offset=0.005,
        smooth=0.005,
        opacity=0.01,
    )
    assert (paper.steps, paper.clip, paper.rates.network, paper.rate_end) == (300_000, 5e-4, 1.5e-4, 0.05)
    assert not paper.model.base and paper.model.width == 1.0 and paper.model.heads == "separate"


def test_crops_agree_with_the_whole_picture(tmp_path: Path) -> None:
    make_subject(tmp_path)
    take = open_capture(tmp_path / "capture").training_takes[0]
    views = TrainingViews(TakeSequence((take,)), poses(), embedded_body(), ["body", "upper"])
    assert views.frames(2) == [0, 2]
    view = views.view(1, "cam1")
    left, top, right, bottom = take.subject_box("cam1", 1, margin=8) or (0, 0, 0, 0)
    part = (slice(top, bottom), slice(left, right))
    mask = take.mask("cam1", 1)[part] > 127
    assert np.array_equal(view.inside.numpy() > 0, mask)
    assert np.allclose(view.image.numpy(), take.image("cam1", 1)[part] / 255.0)
    point = np.array([[0.05, 0.1, 0.1]])
    whole, _ = take.camera("cam1").project(point)
    cropped, _ = view.camera.project(point)
    assert np.allclose(whole - cropped, [[left, top]])
    labels = take.labels("cam1", 1)
    assert labels is not None
    known = view.known.numpy() > 0
    assert np.array_equal(view.labels.numpy()[..., 1][known] > 0, (labels[part] == 3)[known])
    assert not view.labels.numpy()[~mask].any()
    assert known.sum() > 0.5 * known.size and not known[~(view.valid.numpy() > 0)].any()
    small = views.view(1, "cam1", 0.5)
    assert small.image.shape[:2] == (small.camera.height, small.camera.width) == small.silhouette.shape


def test_pictures_are_freed_of_their_cameras_exposure(tmp_path: Path) -> None:
    make_subject(tmp_path)
    take = open_capture(tmp_path / "capture").training_takes[0]
    bright = {"cam1": Exposure((2.0, 2.0, 2.0), (0.0, 0.0, 0.0))}
    args = (TakeSequence((take,)), poses(), embedded_body(), ["body", "upper"])
    plain, freed = TrainingViews(*args), TrainingViews(*args, exposures=bright)
    halved = freed.view(1, "cam1").image.numpy() - plain.view(1, "cam1").image.numpy() / 2
    assert np.abs(halved).max() <= 1 / 255
    assert np.array_equal(freed.view(1, "cam0").image, plain.view(1, "cam0").image)


def test_cache_stays_within_its_bound(tmp_path: Path) -> None:
    make_subject(tmp_path)
    take = open_capture(tmp_path / "capture").training_takes[0]
    views = TrainingViews(
        TakeSequence((take,)), poses(), embedded_body(), ["body", "upper"], cache_bytes=20_000
    )
    first = views.view(0, "cam0").image.clone()
    for frame in range(4):
        for camera in ("cam0", "cam1"):
            views.view(frame, camera)
    assert 0 < views._cached_bytes <= 20_000
    assert np.array_equal(views.view(0, "cam0").image, first)


def test_outline_of_a_square_is_exact() -> None:
    camera = Camera("c", 20, 16, np.array([[10.0, 0, 10], [0, 10, 8], [0, 0, 1]]), np.eye(4))
    vertices = np.array(
        [[-0.5, -0.3, 1], [0.5, -0.3, 1], [0.5, 0.3, 1], [-0.5, 0.3, 1], [0, 0, -1]], np.float32
    )
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 4]], np.int32)
    covered = rasterize_silhouette(vertices, faces, camera)
    expected = np.zeros((16, 20), bool)
    expected[5:11, 5:15] = True
    assert np.array_equal(covered, expected)


def test_tiny_configuration_names_its_result_without_the_device() -> None:
    from stages.shared.artifacts.canonical import to_json

    assert to_json(tiny(device="cpu")) == to_json(tiny(device="cuda"))
