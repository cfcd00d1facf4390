"""The canonical pose and the exact motion of its points with the shape."""

from __future__ import annotations

import math

import torch

from stages.shared.body import (
    canonical_from_rest,
    canonical_rotations,
    canonical_shape_directions,
    embedded_body,
    posed_from_canonical,
    posed_joints,
    posed_vertices,
    shaped_vertices,
    skin,
)


def test_values_at_the_places_of_the_pose_vector() -> None:
    body_pose = canonical_rotations()[1:22].reshape(-1)
    wanted = {2: math.radians(25), 5: -math.radians(25), 57: -math.pi / 2, 60: -math.pi / 2}
    for index, value in enumerate(body_pose.tolist()):
        assert abs(value - wanted.get(index, 0.0)) < 1e-6
    assert float(canonical_rotations()[[0, *range(22, 55)]].abs().max()) == 0


def test_legs_apart_arms_level_palms_to_the_front() -> None:
    body = embedded_body()
    joints = posed_joints(
        body, canonical_rotations(torch.float64), None, torch.zeros(10, dtype=torch.float64)
    )
    assert joints[7, 0] > 0.3 and joints[8, 0] < -0.3  # ankles
    assert abs(joints[16, 1] - joints[20, 1]) < 1e-3  # shoulder and wrist
    palm = torch.linalg.cross(joints[31] - joints[20], joints[25] - joints[20])  # little finger x index
    assert (palm / palm.norm())[2] > 0.8


def test_canonical_pose_maps_to_itself() -> None:
    body = embedded_body()
    betas = torch.randn(10, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    identity = posed_from_canonical(body, canonical_rotations(torch.float64), None, betas)
    torch.testing.assert_close(identity, torch.eye(4, dtype=torch.float64).expand(55, 4, 4))


def test_going_by_the_canonical_pose_equals_posing_directly_where_one_bone_rules() -> None:
    body = embedded_body()
    random = torch.Generator().manual_seed(2)
    rotations = 0.4 * torch.randn(55, 3, dtype=torch.float64, generator=random)
    betas = torch.randn(10, dtype=torch.float64, generator=random)
    translation = torch.randn(3, dtype=torch.float64, generator=random)
    weights = torch.nn.functional.one_hot(torch.from_numpy(body.skin_weights).argmax(1), 55).double()
    rest = shaped_vertices(body, betas)
    canonical = skin(rest, weights, canonical_from_rest(body, betas))
    through = skin(canonical, weights, posed_from_canonical(body, rotations, translation, betas))
    ruled = torch.from_numpy(body.skin_weights).max(1).values > 0.999
    direct = posed_vertices(body, rotations, translation, betas)
    assert int(ruled.sum()) > 500
    torch.testing.assert_close(through[ruled], direct[ruled], atol=2e-3, rtol=0)


def test_shape_directions_are_exact_for_any_shape() -> None:
    body = embedded_body()
    random = torch.Generator().manual_seed(3)
    weights = torch.from_numpy(body.skin_weights).double()
    directions = torch.from_numpy(body.shape_directions).double()
    zero = torch.zeros(10, dtype=torch.float64)
    at_zero = skin(shaped_vertices(body, zero), weights, canonical_from_rest(body, zero))
    moves = canonical_shape_directions(body, weights, directions)
    assert moves.shape == (len(weights), 10, 3)
    for size in (0.3, 10.0):
        betas = size * torch.randn(10, dtype=torch.float64, generator=random)
        wanted = skin(shaped_vertices(body, betas), weights, canonical_from_rest(body, betas))
        torch.testing.assert_close(
            at_zero + torch.einsum("b,vbc->vc", betas, moves), wanted, atol=1e-11, rtol=0
        )
    # Leaving the joints' motion out, as a subtraction of rotated vertex offsets does, is not exact.
    turned = torch.einsum("vj,jkl,vlb->vbk", weights, canonical_from_rest(body, zero)[:, :3, :3], directions)
    assert float((turned - moves).abs().max()) > 1e-3
