"""Anchors: offsets of the poses that were seen, blended between them, fading far away."""

from __future__ import annotations

import torch

from stages.shared.avatar.decoders.key_poses import KeyPoseOffsets


def _line(count: int) -> torch.Tensor:
    return torch.stack([torch.tensor([float(i), 0.0, 0.0]) for i in range(count)])


def test_a_seen_pose_takes_mostly_its_own_anchor() -> None:
    anchors = KeyPoseOffsets(5, (2, 3), 3)
    anchors.fit(_line(5))
    for index in range(5):
        weights = anchors.weights(_line(5)[index])
        assert weights.argmax() == index and weights[index] > 0.7


def test_between_two_anchors_is_their_mean_and_far_away_is_nothing() -> None:
    anchors = KeyPoseOffsets(3, (2, 3), 3)
    anchors.fit(_line(3))
    with torch.no_grad():
        anchors.offsets[:] = torch.tensor([1.0, 2.0, 9.0])[:, None, None, None]
    middle = anchors(torch.tensor([0.5, 0.0, 0.0]))
    assert middle.shape == (2, 3, 2, 3)
    assert torch.allclose(middle, middle[0, 0, 0, 0].expand_as(middle))
    assert 1.0 < middle.max() < 2.0
    assert anchors(torch.tensor([100.0, 0.0, 0.0])).abs().max() == 0


def test_gradient_stays_with_the_poses_that_are_near() -> None:
    anchors = KeyPoseOffsets(6, (2, 3), 3)
    anchors.fit(_line(6))
    anchors(_line(6)[0]).sum().backward()
    assert anchors.offsets.grad[0].abs().min() > 0
    assert anchors.offsets.grad[3:].abs().max() == 0


def test_fewer_anchors_than_poses_spread_out() -> None:
    anchors = KeyPoseOffsets(3, (2, 3), 3)
    anchors.fit(_line(9))
    assert anchors.poses[:, 0].tolist() == [0.0, 4.0, 8.0]


def test_confidence_is_one_where_poses_were_seen() -> None:
    anchors = KeyPoseOffsets(4, (2, 3), 3)
    anchors.fit(_line(4))
    assert all(anchors.confidence(pose) == 1 for pose in _line(4))
    assert anchors.confidence(torch.tensor([1.5, 0.0, 0.0])) > 0.9
    assert 0 < anchors.confidence(torch.tensor([4.0, 0.0, 0.0])) < 0.3
    assert anchors.confidence(torch.tensor([9.0, 0.0, 0.0])) == 0


def test_near_poses_in_long_descriptions_are_all_taken() -> None:
    generator = torch.Generator().manual_seed(0)
    centre = 10 * torch.randn(1, 5000, generator=generator)
    poses = centre + 1e-3 * torch.randn(8, 5000, generator=generator)
    anchors = KeyPoseOffsets(8, (2, 3), 5000)
    anchors.fit(poses)
    for index in range(8):
        assert anchors.weights(poses[index]).argmax() == index


def test_equal_poses_do_not_break_the_bandwidth() -> None:
    anchors = KeyPoseOffsets(2, (2, 3), 3)
    anchors.fit(torch.zeros(4, 3))
    assert torch.isfinite(anchors.weights(torch.zeros(3))).all()


def test_poses_that_are_all_anchors_stay_in_order_though_two_are_alike() -> None:
    poses = _line(4)[[0, 0, 1, 3]]
    for own in (False, True):
        anchors = KeyPoseOffsets(4, (2, 3), 3, own)
        anchors.fit(poses)
        assert torch.equal(anchors.poses, poses) and bool((anchors.bandwidth > 0).all())


def test_own_widths_keep_near_poses_apart_and_let_lonely_ones_reach_far() -> None:
    poses = torch.tensor([[0.0], [0.1], [5.0], [7.0]])
    anchors = KeyPoseOffsets(4, (2, 3), 1, own_widths=True)
    anchors.fit(poses)
    assert all(anchors.weights(poses[index])[index] > 0.7 for index in range(4))
    assert anchors.weights(torch.tensor([4.4]))[2] > 0.7
