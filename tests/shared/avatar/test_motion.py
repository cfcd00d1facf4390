"""Recent motion: zero when still, the velocity in the long run, the same at any frame rate."""

from __future__ import annotations

import numpy as np
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import (
    RATES,
    UP,
    frame_pose,
    motion_length,
    recent_motion,
    recent_motions,
    time_constant,
)
from stages.shared.body import Poses, embedded_body
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube_arrays


def _walk(frames: int, fps: float, speed: float = 1.0, heading: float = 0.0) -> Poses:
    time = np.arange(frames) / fps
    rotations = np.zeros((frames, 55, 3), np.float32)
    rotations[:, 0, 1] = heading
    rotations[:, 4, 0] = 0.5 * time  # a knee turning at 0.5 rad/s
    places = np.zeros((frames, 3))
    places[:, 0], places[:, 2] = speed * time * np.sin(heading), speed * time * np.cos(heading)
    return Poses(rotations, places, np.zeros(10), np.zeros((frames, 10)), fps)  # type: ignore[arg-type]


def test_still_poses_and_first_frames_have_no_motion() -> None:
    for poses, frame in ((_walk(1, 30), 0), (_walk(9, 30), 0), (_walk(9, 30, 0.0)[[3] * 9], 8)):
        found = recent_motion(poses, frame, 2)
        assert len(found) == motion_length(2) and found[UP:].abs().max() < 1e-6
        assert torch.allclose(found[:UP], torch.tensor([0.0, 1.0, 0.0]))
    assert len(recent_motion(_walk(3, 30), 1, 0)) == motion_length(0) == 0


def test_steady_motion_is_remembered_as_its_rates_in_the_roots_frame() -> None:
    for heading in (0.0, 2.0):
        memory = recent_motion(_walk(90, 30, 1.5, heading), 89, 1)[UP:]
        assert torch.allclose(memory[:3], torch.tensor([0.0, 0.0, 1.5]), atol=0.02)
        assert abs(float(memory[3 + 3 * 4]) - 0.5) < 0.01 and len(memory) == RATES


def test_frame_rate_does_not_matter_much() -> None:
    slow, fast = (recent_motion(_walk(int(fps), fps), int(fps) - 1, 3) for fps in (30.0, 120.0))
    assert torch.allclose(slow, fast, atol=0.05)
    assert float(slow[UP + 2]) > 0.95 > 0.8 > float(slow[UP + 2 * RATES + 2]) > 0.5  # fills slowly


def test_anchors_tell_poses_apart_by_motion() -> None:
    """Two frames in one pose, one after walking: each keeps offsets of its own; a still pose is the first."""
    maps = LayerMaps.from_arrays("upper", tube_arrays(0.15), PITCH, CENTRE, GRID)
    config = ModelConfig(width=0.0625, depth=2, style=8, factor=4, anchors=2, anchor_widths="own", history=1)
    model = StyleUNetDecoder(maps, config)
    one = torch.from_numpy(_walk(1, 30).rotations[0])
    pose = frame_pose(embedded_body(), one, torch.zeros(3), torch.zeros(10)).local_transforms
    motions = [recent_motion(_walk(1, 30), 0, 1), recent_motion(_walk(90, 30), 89, 1)]
    model.fit_input([pose, pose], motions)
    assert model.anchors is not None
    model.anchors.offsets.data[1] = 0.02
    offsets = [model(pose, motion=motion).offsets.mean().item() for motion in (*motions, None)]
    assert offsets[1] > 0.015 and offsets[0] < 0.005 and abs(offsets[2] - offsets[0]) < 0.002
    restored = StyleUNetDecoder.from_state(model.config, maps, model.state())
    assert torch.equal(restored(pose, motion=motions[1]).offsets, model(pose, motion=motions[1]).offsets)


def test_a_block_of_rows_is_its_rows_and_follows_the_recursion() -> None:
    noise = np.random.default_rng(0)
    poses = _walk(260, 30, 1.0, 0.3)
    poses.rotations[:, :22] += noise.normal(0, 0.05, (260, 22, 3)).astype(np.float32)
    block = recent_motions(poses, range(128, 192), 3)
    for row in (0, 1, 31, 63):
        assert torch.allclose(block[row], recent_motion(poses, 128 + row, 3), atol=1e-6)
    root = torch.from_numpy(poses.translation).double()
    # m <- m + (1 - e^(-dt/tau)) (rate - m), of the root's speed (turns do not change its length much).
    held = torch.zeros(3, dtype=torch.float64)
    for frame in range(1, 192):
        speed = (root[frame] - root[frame - 1]).norm() * poses.fps
        for memory in range(3):
            held[memory] += (1 - np.exp(-1 / (poses.fps * time_constant(memory)))) * (speed - held[memory])
    found = block[63, UP:].reshape(3, RATES)[:, :3].norm(dim=1).double()
    assert torch.allclose(found, held, rtol=0.02)
    assert recent_motions(poses, range(5, 5), 2).shape[0] == 0
