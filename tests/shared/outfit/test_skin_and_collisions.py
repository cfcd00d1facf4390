"""Skin that is bare again, garments that give way, and garments on another body model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from stages.shared.avatar.deform import Attributes, PosedGaussians, pose_layer
from stages.shared.body import BodyModel, embedded_body
from stages.shared.errors import BadData
from stages.shared.outfit.body_replacement import extrapolate_skin, plan_uncovered_skin
from stages.shared.outfit.collision_correction import CLEARANCE, plan_correction, smooth_field
from stages.shared.outfit.layer import Skin, WornLayer
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.retarget import canonical_joints, retarget_garment
from stages.shared.quaternions import matrices_from_quaternions
from stages.shared.splat.api import rasterize
from tests.shared.outfit.wardrobe import bundle, motion, worn

STILL = torch.eye(4).expand(55, 4, 4)
ZERO = torch.zeros(10)
UPPER, LOWER = worn("upper", source="other"), worn("lower", source="other")


def _body_with_hands() -> WornLayer:
    """The tube whose upper rim follows the left wrist: what the skin's colour is read from."""
    body = worn("body", source="one")
    weights = body.maps.skin_weights.clone()
    top = body.maps.positions[:, 1] > 0.24
    weights[top] = 0
    weights[top, 20] = 1
    return replace(body, maps=replace(body.maps, skin_weights=weights))


BODY = _body_with_hands()
Y = BODY.maps.positions[:, 1].numpy()
SKIN, CLOTH = np.array([0.7, 0.5, 0.4], np.float32), np.array([0.1, 0.1, 0.9], np.float32)


def _colors(shoes: bool = False) -> torch.Tensor:
    """Skin, cloth-coloured where the upper covers it; black below −0.25 with shoes."""
    covered = (Y > -0.06) & (Y < 0.2)
    colors = np.where(covered[:, None], CLOTH, SKIN)
    if shoes:
        colors = np.where(Y[:, None] < -0.25, np.float32(0), colors)
    return torch.from_numpy(colors.astype(np.float32))


def test_covered_skin_takes_colour_and_height_of_the_skin_around() -> None:
    offsets = -0.009 * BODY.maps.normals
    offsets[torch.from_numpy((Y < -0.08) | (Y > 0.22))] = 0.0
    skin = extrapolate_skin(BODY.maps, [UPPER.maps], offsets, _colors())
    assert skin is not None
    deep = skin.covered == 1
    assert deep.any() and (skin.covered[torch.from_numpy(Y > 0.24)] == 0).all()
    assert torch.allclose(skin.colors[deep], torch.from_numpy(SKIN), atol=0.02)
    assert skin.offsets[deep].norm(dim=1).max() < 0.003


def test_shoes_do_not_colour_the_legs() -> None:
    covering = worn("lower", low=-0.24, high=0.0)
    skin = extrapolate_skin(BODY.maps, [covering.maps], torch.zeros(len(Y), 3), _colors(shoes=True))
    assert skin is not None
    deep = (skin.covered == 1) & torch.from_numpy(Y < -0.1)
    assert deep.any() and (skin.colors[deep] - torch.from_numpy(SKIN)).abs().max() < 0.25


def test_nothing_to_spread_from_or_to() -> None:
    tube = worn("body")  # no hands
    assert extrapolate_skin(tube.maps, [UPPER.maps], torch.zeros(len(Y), 3), _colors()) is None
    assert extrapolate_skin(BODY.maps, [], torch.zeros(len(Y), 3), _colors()) is None


def _wearer() -> WornLayer:
    covered = torch.from_numpy(((Y > -0.06) & (Y < 0.2)).astype(np.float32))
    count = len(Y)
    return replace(BODY, skin=Skin(covered, torch.full((count, 3), 0.5), torch.full((count, 3), 0.25)))


def test_only_what_is_bare_now_is_restored() -> None:
    wearer = _wearer()
    naked, dressed = plan_uncovered_skin(wearer, []), plan_uncovered_skin(wearer, [UPPER])
    assert naked is not None and torch.equal(naked.weights, wearer.skin.covered)  # type: ignore[union-attr]
    # Beneath the same garment only its feathered rim is left.
    assert dressed is None or dressed.weights.sum() < 0.35 * naked.weights.sum()
    assert plan_uncovered_skin(BODY, []) is None
    count = len(Y)
    before = Attributes(
        torch.zeros(count, 3),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 0.01),
        torch.full((count,), 0.7),
        torch.zeros(count, 3),
    )
    after = naked.applied(before)
    bare = naked.weights == 1
    assert torch.allclose(after.colors[bare], torch.tensor(0.25)) and (after.colors[~bare] == 0).all()
    assert torch.allclose(after.offsets[bare], torch.tensor(0.5))
    assert torch.equal(after.opacities[~bare], before.opacities[~bare])


@pytest.mark.parametrize(
    ("side", "before", "after"), [((0.0, 0.0, 1.0), 0.9, 0.95), ((-1.0, 0.0, 0.0), 0.1, 0.75)]
)
def test_bare_skin_has_no_gaps(side: tuple[float, float, float], before: float, after: float) -> None:
    """Learned Gaussians that shrank beneath the clothes let the background through; discs do not.

    Seen from the front, and from the side, where front and back texels are 2.4 pitches apart.
    """
    wearer = _wearer()
    assert wearer.skin is not None
    bare = wearer.skin.covered == 1
    count = len(Y)
    shrunk = Attributes(
        torch.zeros(count, 3),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 0.3 * wearer.maps.pitch),
        torch.full((count,), 0.9),
        torch.zeros(count, 3),
    )
    naked = plan_uncovered_skin(wearer, [])
    assert naked is not None
    naked = replace(naked, offsets=torch.zeros(count, 3))
    assert _least_alpha(wearer, shrunk, bare, side) < before
    assert _least_alpha(wearer, naked.applied(shrunk), bare, side) > after
    # Discs lie in the surface, and none is longer than the limit.
    thin = matrices_from_quaternions(naked.quaternions)[:, :, 2]
    assert (thin * functional.normalize(wearer.maps.normals, dim=1)).sum(dim=1).min() > 0.999
    assert naked.looks[:, 3:6].max() <= 1.5 * wearer.maps.pitch + 1e-6


def _least_alpha(
    layer: WornLayer, attributes: Attributes, rows: torch.Tensor, side: tuple[float, float, float]
) -> float:
    """The least opacity of a picture from a side, well inside the rows' own part of the tube."""
    posed = pose_layer(layer.maps, attributes, STILL, ZERO)
    back = torch.tensor(side)
    facing = functional.normalize(layer.maps.normals, dim=1) @ back
    middle = posed.means[rows & (facing > 0.7)].mean(dim=0)
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), back)
    pixels, focal, distance = 64, 3000.0, 3.0
    view = torch.eye(4)
    view[:3, :3] = torch.stack((right, torch.tensor([0.0, -1.0, 0.0]), -back))
    view[:3, 3] = -view[:3, :3] @ middle + torch.tensor([0.0, 0.0, distance])
    camera = torch.tensor([[focal, 0, pixels / 2], [0, focal, pixels / 2], [0, 0, 1]])
    near = facing > 0
    picture = rasterize(
        posed.means[near], None, None, posed.opacities[near], posed.colors[near], view, camera,
        pixels, pixels, covars=posed.covariances[near],
    )  # fmt: skip
    return float(picture.alpha.min())


def _posed(layer: WornLayer) -> PosedGaussians:
    return pose_layer(layer.maps, layer.model(STILL), STILL, ZERO)


def test_a_garment_gives_way_to_a_larger_body() -> None:
    thick = replace(worn("body", offset=0.04, source="one"))
    push = plan_correction(thick, UPPER)
    assert push is not None
    body, before = _posed(thick), _posed(UPPER)
    after = push.applied(before, body)

    moved = after.means - before.means
    outwards = (moved * UPPER.maps.normals).sum(dim=1)
    middle = (UPPER.maps.positions[:, 1] - 0.07).abs() < 0.08
    # The body stands one centimetre out of the garment, and the clearance is kept.
    assert outwards[middle].min() > 0.01 + 0.7 * CLEARANCE
    assert moved.norm(dim=1).max() < 0.03


def test_a_garment_that_touches_nothing_stays() -> None:
    push = plan_correction(BODY, UPPER)
    assert push is not None
    posed = _posed(UPPER)
    assert push.applied(posed, _posed(BODY)) is posed


def test_no_push_among_pieces_learned_together_or_on_another_grid() -> None:
    assert plan_correction(BODY, replace(UPPER, source="one")) is None
    assert plan_correction(BODY, replace(UPPER, maps=replace(UPPER.maps, pitch=0.01))) is None


def test_the_field_meets_every_need_and_fades() -> None:
    push = plan_correction(BODY, UPPER)
    assert push is not None
    need = np.zeros(len(UPPER.maps), np.float32)
    need[100] = 0.02
    along = UPPER.maps.normals.numpy()
    field = smooth_field(push.smoothing, need, along)
    assert field[100] @ along[100] >= 0.02 - 1e-6
    size = np.linalg.norm(field, axis=1)
    assert 0 < np.median(size[size > 1e-5]) < 0.02 and size.argmax() == 100


def _taller(body: BodyModel) -> BodyModel:
    return replace(body, template_vertices=body.template_vertices * np.float32(1.1))


def test_a_garment_of_another_body_model_moves_with_the_bones() -> None:
    small, tall = embedded_body(), _taller(embedded_body())
    joints = canonical_joints(small)
    assert np.allclose(canonical_joints(tall), 1.1 * joints, atol=1e-4)
    wearer = replace(BODY, maps=replace(BODY.maps, positions=1.1 * BODY.maps.positions))
    carried = retarget_garment(UPPER, joints, wearer, tall)
    # The tubes hang on single bones, so every point moves exactly as its bone's canonical place.
    shift = UPPER.maps.skin_weights.numpy() @ (canonical_joints(tall) - joints)
    moved = (carried.maps.positions - UPPER.maps.positions).numpy()
    assert np.allclose(moved, shift, atol=1e-5)
    assert torch.allclose(carried.maps.skin_weights.sum(dim=1), torch.ones(len(UPPER.maps)), atol=1e-5)
    assert carried.beneath is None and carried.model is UPPER.model


def test_bundles_of_another_body_model_are_converted_or_refused() -> None:
    body, far = bundle(BODY), bundle(UPPER, digest="cd" * 32)
    with pytest.raises(BadData, match="where its bones were"):
        outfit_of_bundles([("body", body), ("far.gwg", far)])
    far.arrays["joints"] = canonical_joints(embedded_body())
    worn_ = outfit_of_bundles([("body", body), ("far.gwg", far)])
    assert worn_.names == ("body", "upper")
    means = worn_.composite(motion(), 2).means
    assert torch.isfinite(means).all()
    same = outfit_of_bundles([("body", body), ("near.gwg", bundle(UPPER))], swap=False)
    plain = same.composite(motion(), 2).means
    # With equal bones nothing moves but for the weights, which are the body's own.
    assert (means - plain).norm(dim=1).max() < 0.02
