"""What lies beneath a garment, and what the body takes over from the garment's source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from stages.shared.avatar.deform import Attributes
from stages.shared.outfit.body_replacement import covered_texels, plan_swap
from stages.shared.outfit.coverage import covered_weights
from stages.shared.outfit.layer import BodyUnderGarment
from stages.shared.quaternions import slerp
from tests.shared.outfit.wardrobe import PITCH, worn

BODY, UPPER = worn("body", source="one"), worn("upper", source="other")
Y = BODY.maps.positions[:, 1].numpy()


def test_covered_is_what_lies_inside_the_garment() -> None:
    weights = covered_weights(BODY.maps, UPPER.maps, feather=0.0)
    inside = (Y > -0.06) & (Y < 0.2)
    near_edge = (np.abs(Y + 0.06) < 2 * PITCH) | (np.abs(Y - 0.2) < 2 * PITCH)
    assert (weights[inside & ~near_edge] == 1).all()
    assert (weights[~inside & ~near_edge] == 0).all()


def test_feather_grows_from_the_edge_inwards_and_not_from_the_silhouette() -> None:
    weights = covered_weights(BODY.maps, UPPER.maps, feather=0.08)
    texels = BODY.maps.texels.numpy()
    middle = texels[:, 2] == 50
    profile = weights[middle & (texels[:, 0] == 0)]
    assert profile.max() == 1 and set(profile[[0, -1]]) == {0.0}
    assert ((profile > 0) & (profile < 1)).sum() >= 4
    rim = (texels[:, 2] == texels[:, 2].max()) & (np.abs(Y - 0.07) < 0.02)
    assert (weights[rim] == 1).all()


def test_a_garment_behind_the_body_covers_nothing() -> None:
    inner = worn("upper", radius=0.06)
    assert covered_weights(BODY.maps, inner.maps).max() == 0


def test_a_garment_far_away_covers_nothing() -> None:
    moved = UPPER.maps.positions + 0.3 * UPPER.maps.normals
    assert covered_weights(BODY.maps, replace(UPPER.maps, positions=moved)).max() == 0


def _beneath(value: float) -> BodyUnderGarment:
    texels = covered_texels(BODY.maps, UPPER.maps)
    count = len(texels)
    turn = torch.tensor([np.cos(0.3), 0.0, np.sin(0.3), 0.0], dtype=torch.float32)
    return BodyUnderGarment(BODY.maps.texels[texels], torch.full((count, 3), value), turn.repeat(count, 1))


def _attributes() -> Attributes:
    count = len(BODY.maps)
    return Attributes(
        torch.full((count, 3), 0.5),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 0.01),
        torch.full((count,), 0.7),
        torch.full((count, 3), 0.3),
    )


def test_swap_changes_offset_and_rotation_of_covered_texels_only() -> None:
    swap = plan_swap(BODY, replace(UPPER, beneath=_beneath(-0.2)), feather=0.08)
    assert swap is not None and swap.count > 0
    before = _attributes()
    after = swap.applied(before)
    bare, deep = swap.weights == 0, swap.weights == 1
    assert torch.equal(after.offsets[bare], before.offsets[bare])
    assert torch.allclose(after.quaternions[bare], before.quaternions[bare])
    assert torch.allclose(after.offsets[deep], torch.tensor(-0.2))
    assert torch.allclose(after.quaternions[deep][:, 2], torch.tensor(np.sin(0.3), dtype=torch.float32))
    assert after.colors is before.colors and after.scales is before.scales
    assert after.opacities is before.opacities
    between = after.offsets[(~bare) & (~deep), 0]
    assert ((between > -0.2) & (between < 0.5)).all() and len(between) > 0


def test_no_swap_among_pieces_learned_together_or_on_another_grid() -> None:
    garment = replace(UPPER, beneath=_beneath(0.0))
    assert plan_swap(BODY, replace(garment, source="one")) is None
    assert plan_swap(BODY, UPPER) is None
    assert plan_swap(BODY, replace(garment, maps=replace(garment.maps, pitch=0.01))) is None


def test_texels_that_only_one_body_has_stay_as_they_are() -> None:
    beneath = _beneath(1.0)
    half = len(beneath.texels) // 2
    part = BodyUnderGarment(beneath.texels[:half], beneath.offsets[:half], beneath.quaternions[:half])
    swap = plan_swap(BODY, replace(UPPER, beneath=part))
    whole = plan_swap(BODY, replace(UPPER, beneath=beneath))
    assert swap is not None and whole is not None
    assert 0 < swap.count < whole.count
    carried = {tuple(texel) for texel in part.texels.tolist()}
    changed = BODY.maps.texels[swap.weights > 0].tolist()
    assert all(tuple(texel) in carried for texel in changed)


@pytest.mark.parametrize("amount", [0.0, 0.3, 1.0])
def test_slerp_is_that_of_scipy(amount: float) -> None:
    random = np.random.default_rng(0)
    start, end = Rotation.random(20, random_state=1), Rotation.random(20, random_state=2)
    first, second = (torch.from_numpy(r.as_quat(scalar_first=True)) for r in (start, end))
    flips = torch.from_numpy(random.choice([-1.0, 1.0], (20, 1)))
    found = slerp(first, second * flips, torch.full((20, 1), amount, dtype=torch.float64))
    for index in range(20):
        pair = Rotation.concatenate([start[index : index + 1], end[index : index + 1]])
        expected = Slerp([0, 1], pair)(amount)
        turned = Rotation.from_quat(found[index].numpy(), scalar_first=True)
        assert (expected.inv() * turned).magnitude() < 1e-6


def test_slerp_of_equal_rotations_is_finite() -> None:
    one = torch.tensor([[1.0, 0, 0, 0]])
    assert torch.allclose(slerp(one, -one, torch.tensor([[0.5]])).abs(), one)
