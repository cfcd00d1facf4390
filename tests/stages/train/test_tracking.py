"""Following garments: cells, flow as equations, and a run that can stop in the middle of it."""

from __future__ import annotations

import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from stages.shared.avatar.decoders.key_poses import sampled_maps
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.capture import Camera
from stages.train import schedule, stage
from stages.train.config import TrackConfig
from stages.train.resolve import affordable_tracking
from stages.train.take_sequence import TakeSequence
from stages.train.tracking.control_grid import ControlGrid, conjugate_gradient
from stages.train.tracking.normal_equations import NormalEquations, estimate_flow
from stages.train.tracking.tracker import Checkpoint, Tracker
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube_arrays
from tests.stages.train.scene import TINY, make_subject, tiny

_TRACK = TrackConfig(frame_step=1, cell=8, warm_up=3, rounds=2)


def _model() -> StyleUNetDecoder:
    maps = LayerMaps.from_arrays("upper", tube_arrays(0.15), PITCH, CENTRE, GRID)
    return StyleUNetDecoder(maps, TINY.model)


def _cells(model: StyleUNetDecoder) -> ControlGrid:
    assert model.anchors is not None
    height, width = model.anchors.offsets.shape[2:]
    return ControlGrid.of(model.maps, model.sample_points, (height, width))


def test_cells_say_of_texels_what_sampling_the_anchor_says() -> None:
    model = _model()
    cells = _cells(model)
    assert model.anchors is not None
    height, width = model.anchors.offsets.shape[2:]
    images = torch.randn(2, 3, height, width, generator=torch.Generator().manual_seed(0))
    flat = images.permute(0, 2, 3, 1).reshape(-1, 3).double().numpy()
    expected = sampled_maps(images, model.sample_points, model.maps.view_counts).numpy()
    assert np.allclose(cells.basis @ flat[cells.where], expected, atol=1e-5)


def test_smoothness_knows_no_cost_for_a_shift_and_ties_front_to_back() -> None:
    cells = _cells(_model())
    ones = np.ones((len(cells.where), 3))
    assert np.abs(cells.bending @ ones).max() < 1e-9 and np.abs(cells.stretch @ ones).max() < 1e-9
    count = len(cells.where)
    half = int(np.searchsorted(cells.where, cells.where.max() // 2))
    values = np.zeros((count, 1))
    values[:half] = 1.0  # the front alone moves: seams feel it
    assert float((values.T @ (cells.stretch @ values))[0, 0]) > 0


def test_conjugate_gradients_solve_what_a_dense_solver_solves() -> None:
    generator = np.random.default_rng(0)
    root = generator.normal(size=(12, 12))
    matrix, right = root @ root.T + np.eye(12), generator.normal(size=(12, 3))
    found = conjugate_gradient(lambda x: matrix @ x, right, 60)
    assert np.allclose(found, np.linalg.solve(matrix, right), atol=1e-4)
    assert not conjugate_gradient(lambda x: matrix @ x, np.zeros((12, 3)), 5).any()


def _texture() -> np.ndarray:
    noise = np.random.default_rng(1).random((96, 96)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def test_equations_find_a_known_shift_from_two_cameras() -> None:
    """Points on a plane, flow head-on and from a side, displaced in 3D; the pictures are shifted to match."""
    truth = np.array([0.012, -0.008, 0.0])
    column, row = np.meshgrid(np.linspace(-0.1, 0.1, 21), np.linspace(-0.1, 0.1, 21))
    means = np.stack((column.ravel(), row.ravel(), np.zeros(column.size)), axis=1)
    equations = NormalEquations.zero(len(means))
    intrinsics = np.array([[400.0, 0, 48], [0, 400, 48], [0, 0, 1]])
    source = _texture()
    for angle in (0.0, 0.5):
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn, (0, 0, 2.0)
        camera = Camera("c", 96, 96, intrinsics, matrix)
        before, depth = camera.project(means)
        shift = (camera.project(means + truth)[0] - before).mean(axis=0)
        target = cv2.warpAffine(source, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), (96, 96))
        flow = estimate_flow(source, target, fine=True)
        assert flow is not None
        everywhere = np.ones((96, 96), bool)
        per_pixel = np.zeros((96, 96))
        for (x, y), z in zip(before.astype(int), depth, strict=True):
            per_pixel[y, x] = z
        jacobian = np.tile(np.eye(3), (len(means), 1, 1))
        equations.add(means, jacobian, camera, per_pixel, everywhere, everywhere, flow, 1.0)
    found = np.linalg.solve(equations.matrix.sum(axis=0), equations.right.sum(axis=0))
    assert np.allclose(found, truth, atol=0.002)


def test_stripes_say_nothing_along_themselves() -> None:
    rows = (127 + 100 * np.sin(np.arange(96) / 3.0)).astype(np.uint8)
    flow = estimate_flow(np.tile(rows[:, None], (1, 96)), np.tile(rows[:, None], (1, 96)), fine=False)
    assert flow is not None
    assert flow.tensor[:, 0].max() < 1e-3 < 0.5 < np.median(flow.tensor[:, 2])
    assert estimate_flow(np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8), fine=False) is None


def test_tracked_run_resumes_to_the_bit_wherever_it_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = make_subject(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    straight = stage.run(subject, tiny(steps=4, track=_TRACK))
    follow = Tracker.follow

    def interrupted(self: Tracker, place: int, checkpoint: Checkpoint) -> None:
        pictures = iter(range(100))

        def count() -> None:
            if place == 1 and next(pictures) == 2:
                os.kill(os.getpid(), signal.SIGINT)
            checkpoint()

        follow(self, place, count)

    monkeypatch.setattr(Tracker, "follow", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stage.run(tmp_path / "b" / "subject", tiny(steps=4, track=_TRACK))
    monkeypatch.undo()
    again = stage.run(tmp_path / "b" / "subject", tiny(steps=4, track=_TRACK))
    for layer in ("body", "upper"):
        for name, values in straight.artifact.arrays(layer).items():
            assert np.array_equal(again.artifact.arrays(layer)[name], values), name
    offsets = straight.artifact.arrays("upper")["anchors.offsets"]
    assert len(offsets) == 4 and np.isfinite(offsets).all() and np.abs(offsets[3]).max() > 1e-4


def test_without_segmentation_no_label_image_is_learned_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Label images with layers exchanged change what is learned, unless segmentation is left out.

    The body's silhouette has hair and shoes from the labels, so it is left out of both.
    """
    subject, labels = make_subject(tmp_path), TakeSequence.labels

    def learned(parts: tuple[str, ...]) -> dict[str, np.ndarray]:
        config = tiny(steps=2, track=_TRACK, without=parts)
        return stage.run(subject, config, force=True).artifact.arrays("upper")

    before = {parts: learned(parts) for parts in (("bs",), ("bs", "sg"))}

    def exchanged(self: TakeSequence, camera: str, frame: int) -> np.ndarray:
        found = labels(self, camera, frame)
        assert found is not None
        return np.where(found == 0, 3, np.where(found == 3, 0, found)).astype(np.uint8)

    monkeypatch.setattr(TakeSequence, "labels", exchanged)
    for parts, arrays in before.items():
        after = learned(parts)
        same = all(np.array_equal(values, after[name]) for name, values in arrays.items())
        assert same is ("sg" in parts)


def test_tracking_replaces_small_pictures_and_flow() -> None:
    config = tiny(coarse_until=0.5, weights=replace(TINY.weights, flow=1.0))
    assert schedule.is_coarse(config, 0.1) and schedule.stage_weights(config, 0.1).flow == 1
    tracked = replace(config, track=_TRACK)
    assert not schedule.is_coarse(tracked, 0.1) and schedule.stage_weights(tracked, 0.1).flow == 0


def test_short_runs_follow_fewer_frames() -> None:
    """200 frames in 8 cameras are 240 s: a third of 12 minutes and more, but not of 3."""
    config = tiny(frame_step=5, track=_TRACK)
    takes: Any = SimpleNamespace(frames=range(200), training_cameras=range(8))
    steps = {
        minutes: affordable_tracking(replace(config, minutes=minutes), takes).track.frame_step
        for minutes in (0.0, 30.0, 3.0, 1.0, 0.01)
    }
    assert steps[0.0] == steps[30.0] == 1 and steps[3.0] == 5 and steps[1.0] == 15 and steps[0.01] == 0
