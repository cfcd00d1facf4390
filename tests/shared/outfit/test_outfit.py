"""Slots, order and shape of an outfit; pictures of it; cameras that frame it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from stages.shared.body import embedded_body, posed_joints
from stages.shared.errors import BadData, UsageProblem
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.sources import parse_betas, parse_frames
from stages.shared.outfit.viewpoints import viewpoint_cameras
from tests.shared.outfit.wardrobe import bundle, cameras, motion, outfit, worn

BODY, LOWER, UPPER, OUTER = (
    (name, bundle(worn(name, source=name))) for name in ("body", "lower", "upper", "outer")
)


def test_layers_decide_the_order_and_not_the_names() -> None:
    for order in ([BODY, LOWER, UPPER, OUTER], [OUTER, UPPER, LOWER, BODY], [UPPER, BODY, OUTER, LOWER]):
        assert outfit_of_bundles(order).names == ("body", "lower", "upper", "outer")


def test_every_sensible_set_of_garments_can_be_worn() -> None:
    for count in range(4):
        for chosen in itertools.combinations([LOWER, UPPER, OUTER], count):
            dressed = outfit_of_bundles([BODY, *chosen])
            assert len(dressed.layers) == count + 1 and len(dressed.swaps) == count


def test_conflicts_are_explained() -> None:
    dress = ("dress.gwg", bundle(worn("upper"), slots=("lower", "upper")))
    other = ("trousers.gwg", bundle(worn("lower")))
    with pytest.raises(UsageProblem, match=r"dress.gwg and trousers.gwg are both worn as lower"):
        outfit_of_bundles([BODY, dress, other])
    with pytest.raises(UsageProblem, match="2 bodies"):
        outfit_of_bundles([BODY, ("again", BODY[1])])
    with pytest.raises(UsageProblem, match="None of the bundles is a body"):
        outfit_of_bundles([UPPER])
    with pytest.raises(BadData, match="another body model"):
        outfit_of_bundles([BODY, ("far.gwg", bundle(worn("upper"), digest="cd" * 32))])


def test_betas_come_from_the_body_and_move_the_garment_too() -> None:
    own = outfit_of_bundles([BODY, UPPER])
    assert np.array_equal(own.betas, BODY[1].arrays["betas"])
    betas = np.zeros(10, np.float32)
    plain = outfit_of_bundles([BODY, UPPER], betas)
    betas = betas.copy()
    betas[0] = 2.0
    wide = outfit_of_bundles([BODY, UPPER], betas)
    rest = motion(1)
    rest.rotations[:] = 0
    for layer in plain.layers:
        # Direction 0 of the tubes is 1 cm along the normal; in the rest pose their bones do not move them.
        before = plain.posed(rest, 0)[layer.name].means
        after = wide.posed(rest, 0)[layer.name].means
        assert torch.allclose(after - before, 0.02 * layer.maps.normals, atol=1e-5)


def test_pass_off_and_layers_alone_leave_the_composite_as_it_is() -> None:
    composite = outfit("body", "lower", "upper").composite(motion(), 2)
    plain = render_image(composite, cameras()[0])
    with_layers = render_image(composite, cameras()[0], each_layer=True)
    assert np.abs(plain.color - with_layers.color).max() < 1e-5
    assert set(with_layers.layers) == {"body", "lower", "upper"}
    assert np.array_equal(plain.labels, with_layers.labels)
    assert {0, 3, 4, 255} == set(np.unique(plain.labels))
    seen = plain.alpha > 0.9
    assert (np.abs(plain.depth[seen] - plain.depth[seen].mean()) < 0.4).all()


def test_pass_repairs_a_body_that_pokes_through() -> None:
    dressed = outfit("body", "upper")
    layers = (worn("body", offset=0.035), dressed.layers[1])
    poking = type(dressed)(dressed.body_model, dressed.betas, layers)
    composite = poking.composite(motion(), 2)
    camera = cameras()[0].scaled(3)
    before = render_image(composite, camera)
    after = render_image(composite, camera, PenetrationConfig())
    assert after.repaired is not None
    assert (after.labels == 3).sum() >= (before.labels == 3).sum() + after.repaired.sum() * 0.9
    assert after.counts.keys() == {"body/upper"}


def test_straight_alpha_over_black_is_the_render() -> None:
    shot = render_image(outfit("body").composite(motion(), 0), cameras()[1])
    png = shot.straight().astype(float)
    on_black = png[..., :3] * png[..., 3:] / 255
    assert np.abs(on_black - shot.on((0, 0, 0))).max() <= 1.5
    assert np.array_equal(shot.on((1, 1, 1))[shot.alpha == 0], np.full(((shot.alpha == 0).sum(), 3), 255))


@pytest.mark.parametrize("kind", ["static", "orbit"])
@pytest.mark.parametrize("size", [(120, 160), (200, 100)])
def test_cameras_see_every_joint(kind: str, size: tuple[int, int]) -> None:
    poses = motion(12)
    poses.translation[:, 0] = np.linspace(-1.5, 1.5, 12)
    poses.rotations[:, 0, 1] = 1.0
    found = viewpoint_cameras(kind, embedded_body(), poses, np.zeros(10, np.float32), size)
    assert len(found) == 12
    for frame, camera in enumerate(found):
        joints = posed_joints(
            embedded_body(),
            torch.from_numpy(poses.rotations[frame]),
            torch.from_numpy(poses.translation[frame]),
            torch.zeros(10),
        )
        pixels, depth = camera.project(joints.numpy())
        assert (depth > 0.5).all() and camera.in_view(pixels).all()
        assert np.ptp(pixels[:, 1]) > 0.3 * size[1] or kind == "static"


def test_static_camera_stands_before_the_face() -> None:
    poses = motion(2)
    poses.rotations[:, 0, 1] = np.pi / 2  # facing +x
    camera = viewpoint_cameras("static", embedded_body(), poses, np.zeros(10, np.float32), (100, 100))[0]
    assert camera.centre[0] > 2 and abs(camera.centre[2]) < 1
    with pytest.raises(UsageProblem):
        viewpoint_cameras("spiral", embedded_body(), poses, np.zeros(10, np.float32), (100, 100))


def test_texts_of_the_command_line() -> None:
    assert parse_frames("", 3) == [0, 1, 2] and parse_frames("1:10:4", 8) == [1, 5]
    assert parse_betas("") is None
    assert np.array_equal(parse_betas("1,-2"), np.array([1, -2] + [0] * 8, np.float32))
    for wrong in ("1:2:3:4", "5", "a:b", "7:3", "0:3:0"):
        with pytest.raises(UsageProblem):
            parse_frames(wrong, 8)
    for wrong in ("x", "1,2,nan", ",".join("1" * 11), "100"):
        with pytest.raises(UsageProblem):
            parse_betas(wrong)
