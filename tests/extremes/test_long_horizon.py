"""Much of the same: ten thousand frames, a thousand changes of shape, a hundred thousand steps."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.shared.avatar.deform import Attributes, pose_layer, shaped_positions
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import embedded_body
from stages.shared.splat.api import rasterize
from tests.shared.avatar.tubes import tube

SIDE = 24


def resident_bytes() -> int:
    """Memory of this process that is in use now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def attributes(maps: LayerMaps) -> Attributes:
    count = len(maps)
    identity = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    scales = maps.spacing[:, None].expand(count, 3)
    return Attributes(torch.zeros(count, 3), identity, scales, torch.full((count,), 0.9), maps.colors)


def picture(maps: LayerMaps, number: int) -> torch.Tensor:
    """Frame `number` of an endless motion, from pose to pixels."""
    rotations = torch.zeros(55, 3)
    rotations[3, 2] = 0.5 * np.sin(0.1 * number)
    rotations[0, 1] = 0.01 * number
    pose = frame_pose(embedded_body(), rotations, torch.zeros(3), torch.zeros(10))
    posed = pose_layer(maps, attributes(maps), pose.transforms, pose.betas)
    view = torch.eye(4)
    view[1, 1], view[2, 2], view[2, 3] = -1, -1, 2
    lens = torch.tensor([[30.0, 0, SIDE / 2], [0, 30, SIDE / 2], [0, 0, 1]])
    return rasterize(
        posed.means,
        None,
        None,
        posed.opacities,
        posed.colors,
        view,
        lens,
        SIDE,
        SIDE,
        covars=posed.covariances,
    ).features


def animate(frames: int) -> None:
    maps = tube()
    first = picture(maps, 7)
    assert first.max() > 0.3
    for number in range(20):
        picture(maps, number)
    before = resident_bytes()
    for number in range(frames):
        assert torch.isfinite(picture(maps, number)).all(), number
    assert resident_bytes() - before < 16 << 20
    assert torch.equal(picture(maps, 7), first)


def change_shapes(times: int) -> float:
    """Farthest that a point has moved after `times` shapes, each put on and taken off again, m."""
    maps = tube()
    start = maps.positions.clone()
    random = torch.Generator().manual_seed(0)
    for _ in range(times):
        betas = 3 * torch.randn(10, generator=random)
        worn = replace(maps, positions=shaped_positions(maps, betas))
        maps = replace(worn, positions=shaped_positions(worn, -betas))
    return float((maps.positions - start).abs().max())


def optimise(steps: int) -> tuple[float, float]:
    """First and last loss of five Gaussians that learn a picture; every number on the way is finite."""
    random = torch.Generator().manual_seed(1)
    means = torch.rand(5, 3, generator=random) - 0.5
    leaves = {
        "means": means,
        "quats": torch.randn(5, 4, generator=random),
        "scales": torch.full((5, 3), -2.0),
        "opacities": torch.zeros(5),
        "colors": torch.rand(5, 3, generator=random),
    }
    for leaf in leaves.values():
        leaf.requires_grad_()
    rows, columns = torch.meshgrid(torch.arange(12), torch.arange(12), indexing="ij")
    truth = torch.stack([rows / 12, columns / 12, (rows + columns) % 4 / 4], dim=-1)
    view = torch.eye(4)
    view[2, 3] = 2
    lens = torch.tensor([[14.0, 0, 6], [0, 14, 6], [0, 0, 1]])
    adam = torch.optim.Adam(list(leaves.values()), lr=5e-3)
    losses = []
    for step in range(steps):
        adam.zero_grad()
        scales, opacities = leaves["scales"].clamp(-9, 1).exp(), leaves["opacities"].sigmoid()
        drawn = rasterize(
            leaves["means"], leaves["quats"], scales, opacities, leaves["colors"], view, lens, 12, 12
        )
        loss = (drawn.features - truth).abs().mean()
        loss.backward()
        assert all(
            bool(torch.isfinite(leaf.grad).all()) for leaf in leaves.values() if leaf.grad is not None
        ), step
        adam.step()
        losses.append(float(loss.detach()))
    assert all(bool(torch.isfinite(leaf).all()) for leaf in leaves.values())
    return losses[0], losses[-1]


def test_sixty_frames_leave_nothing_behind() -> None:
    animate(60)


@pytest.mark.long
def test_ten_thousand_frames_leave_nothing_behind() -> None:
    animate(10_000)


def test_fifty_shapes_do_not_drift() -> None:
    assert 0 < change_shapes(50) < 5e-7


@pytest.mark.long
def test_a_thousand_shapes_do_not_drift() -> None:
    """Rounding errors cancel: what is put on is what is taken off."""
    assert 0 < change_shapes(1_000) < 1e-6


def test_a_hundred_and_fifty_steps_stay_finite_and_learn() -> None:
    first, last = optimise(150)
    assert last < 0.7 * first


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_a_hundred_thousand_steps_stay_finite() -> None:
    first, last = optimise(100_000)
    assert last < 0.6 * first
