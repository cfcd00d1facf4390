"""Which texels of a garment training pictures show, and what becomes of the others."""

from __future__ import annotations

import numpy as np
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.registry import new_decoder
from stages.shared.avatar.fabric_fill import covering_discs
from stages.shared.avatar.pose import FramePose
from stages.shared.capture import Camera
from stages.train.observation import fill_unobserved, observed_texels
from tests.shared.avatar.tubes import tube

STILL = FramePose(torch.eye(4).repeat(55, 1, 1), torch.eye(4).repeat(55, 1, 1), torch.zeros(10))
PLAIN = ModelConfig(networks="none")


def ring(count: int = 6, size: int = 160) -> list[Camera]:
    """Cameras 2 m around the y axis that look at the origin."""
    cameras = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        back = np.array([np.sin(angle), 0.0, np.cos(angle)])
        right, up = np.array([np.cos(angle), 0.0, -np.sin(angle)]), np.array([0.0, 1.0, 0.0])
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = np.stack([right, -up, -back])
        camera_from_world[:3, 3] = [0, 0, 2]
        intrinsics = np.array([[200.0, 0, size / 2], [0, 200.0, size / 2], [0, 0, 1]])
        cameras.append(Camera(f"cam{index}", size, size, intrinsics, camera_from_world))
    return cameras


def shirt_under_vest() -> dict[str, object]:
    """A shirt 60 cm high, and a vest around its upper half."""
    maps = {"upper": tube("upper", radius=0.15), "outer": tube("outer", radius=0.2, low=0.0)}
    return {name: new_decoder(one, PLAIN, poses=1) for name, one in maps.items()}


def observed(models: dict[str, object]) -> dict[str, torch.Tensor]:
    return observed_texels(models, [0, 5], lambda frame: ring(), lambda frame: STILL)  # type: ignore[arg-type]


def test_what_the_vest_covers_is_not_observed() -> None:
    models = shirt_under_vest()
    found = observed(models)
    x, height, _ = models["upper"].maps.positions.numpy().T  # type: ignore[attr-defined]
    facing = np.abs(x) < 0.1  # at the sides a map has one texel where the tube has many
    assert not found["upper"].numpy()[facing & (height > 0.06) & (height < 0.24)].any()
    assert found["upper"].numpy()[facing & (height < -0.04)].all()
    assert found["outer"].numpy().mean() > 0.9


def test_a_picture_does_not_count_where_its_labels_show_a_layer_further_out() -> None:
    models = shirt_under_vest()
    del models["outer"]  # as where bones let the shirt stick out of the vest
    lower_half = np.full((160, 160), 3, np.uint8)
    lower_half[:80] = 5  # the vest, above the middle
    found = observed_texels(models, [0, 5], lambda frame: ring(), lambda frame: STILL, lambda *_: lower_half)  # type: ignore[arg-type]
    x, height, _ = models["upper"].maps.positions.numpy().T  # type: ignore[attr-defined]
    facing = np.abs(x) < 0.1
    assert not found["upper"].numpy()[height > 0.03].any()
    assert found["upper"].numpy()[facing & (height < -0.04)].all()


def test_without_the_vest_all_of_the_shirt_is_observed() -> None:
    models = shirt_under_vest()
    del models["outer"]
    assert observed(models)["upper"].numpy().mean() > 0.9


def test_few_pictures_of_one_frame_are_enough() -> None:
    """Four cameras show each side of a shirt in one or two pictures, most of them at an angle."""
    models = shirt_under_vest()
    del models["outer"]
    found = observed_texels(models, [0], lambda frame: ring(4), lambda frame: STILL)  # type: ignore[arg-type]
    assert found["upper"].numpy().mean() > 0.9


def test_clothes_that_a_fitted_body_sticks_out_of_are_observed() -> None:
    maps = {"body": tube("body", radius=0.16), "upper": tube("upper", radius=0.15)}
    models = {name: new_decoder(one, PLAIN, poses=1) for name, one in maps.items()}
    assert observed(models)["upper"].numpy().mean() > 0.9


def test_unobserved_texels_become_discs_of_the_fabric_without_gaps() -> None:
    models = shirt_under_vest()
    shirt = models["upper"]
    seen = observed(models)["upper"]
    parameters = shirt.base_parameters()  # type: ignore[attr-defined]
    with torch.no_grad():
        for name in ("color", "opacity", "scale"):
            parameters[name][~seen] = 3.0
    before = {name: values.detach().clone() for name, values in parameters.items()}
    shirt.set_observed(seen)  # type: ignore[attr-defined]
    fill_unobserved(shirt)  # type: ignore[arg-type]
    colors = torch.sigmoid(parameters["color"])
    fabric = torch.sigmoid(before["color"])[seen].unique(dim=0)
    nearest = torch.cdist(colors[~seen], fabric).min(dim=1).values
    assert float(nearest.detach().max()) < 0.02, "only colours that the fabric has"
    quaternions, scales, opacities = covering_discs(shirt.maps)  # type: ignore[attr-defined]
    torch.testing.assert_close(parameters["scale"][~seen].exp(), scales[~seen])
    torch.testing.assert_close(parameters["quaternion"][~seen], quaternions[~seen])
    torch.testing.assert_close(torch.sigmoid(parameters["opacity"][~seen]), opacities[~seen])
    for name, values in parameters.items():
        torch.testing.assert_close(values[seen], before[name][seen], rtol=0, atol=0)
