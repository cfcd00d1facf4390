"""The blendshape decoder: the sum that its docstring states; it learns, fades and keeps its state."""

from __future__ import annotations

import json

import pytest
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.blendshapes import (
    BlendshapeDecoder,
    BlendshapeSizes,
)
from stages.shared.avatar.decoders.registry import load_decoder, new_decoder
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.decoders.texel_attributes import BASIS_GROUPS, group_channels
from stages.shared.errors import BadData, UsageProblem
from stages.shared.quaternions import matrices_from_quaternions
from tests.shared.avatar.tubes import tube

CONFIG = ModelConfig(decoder="blendshapes", ranks=(3, 2, 1))


def _pose(angle: float) -> torch.Tensor:
    transforms = torch.eye(4).repeat(55, 1, 1)
    half = torch.tensor([angle / 2])
    turn = torch.stack((half.cos(), half.sin(), half * 0, half * 0), 1)
    transforms[3, :3, :3] = matrices_from_quaternions(turn)[0]
    return transforms


POSES = [_pose(0.15 * index) for index in range(8)]


def _fitted(learned: bool = True) -> BlendshapeDecoder:
    model = new_decoder(tube(), CONFIG, len(POSES))
    assert isinstance(model, BlendshapeDecoder)
    model.fit_input(POSES)
    if learned:
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    return model


def test_a_fresh_model_is_the_baked_surface() -> None:
    model, network = (
        _fitted(learned=False),
        StyleUNetDecoder(tube(), ModelConfig(width=0.0625, depth=2, style=8)),
    )
    pose = _pose(0.4)
    for name in ("offsets", "quaternions", "scales", "opacities", "colors"):
        assert torch.equal(getattr(model(pose), name), getattr(network(pose), name)), name


@pytest.mark.parametrize("history", [0, 2])
def test_no_array_of_its_state_is_empty(history: int) -> None:
    config = ModelConfig(decoder="blendshapes", ranks=(3, 2, 1), history=history)
    model = new_decoder(tube(), config, len(POSES))
    assert all(tensor.numel() for tensor in model.state_dict().values()), "a bundle refuses empty tensors"


def test_the_residual_is_mean_plus_coefficients_times_bases() -> None:
    model, pose = _fitted(), _pose(0.4)
    model.mean_residual.normal_(generator=torch.Generator().manual_seed(2))
    squared = (
        (model.coefficients.describe(pose, None) - model.coefficients.centres).double().square().sum(dim=1)
    )
    kernel = torch.exp(-squared / (2 * model.coefficients.bandwidth.double() ** 2))
    coefficients = kernel @ model.coefficients.weights.double()
    expected = model.mean_residual.double().clone()
    first = 0
    for group in BASIS_GROUPS:
        for k in range(getattr(model.sizes, group)):
            for place, channel in enumerate(group_channels(group)):
                basis = getattr(model, f"basis_{group}")[:, place, k].double()
                expected[:, channel] += coefficients[first + k] * basis
        first += getattr(model.sizes, group)
    assert torch.allclose(model.residual(pose).double(), expected, atol=1e-5)


def test_coefficients_have_unit_spread_over_the_training_poses() -> None:
    values = torch.stack([_fitted(learned=False).coefficients(pose) for pose in POSES])
    assert torch.allclose((values - values.mean(dim=0)).square().mean(dim=0), torch.ones(6), atol=0.05)


def test_far_from_every_pose_the_mean_remains() -> None:
    model = _fitted()
    far = _pose(0.0)
    far[:22, :3, :3] = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    assert torch.allclose(model.residual(far), model.mean_residual, atol=1e-5)


def test_gradient_reaches_every_basis() -> None:
    model = _fitted(learned=False)
    model.residual(POSES[2]).square().sum().backward()
    assert all(getattr(model, f"basis_{group}").grad is not None for group in BASIS_GROUPS)
    model.zero_grad()
    (model.residual(POSES[2]) - 1.0).square().sum().backward()
    for group in BASIS_GROUPS:
        assert getattr(model, f"basis_{group}").grad.abs().max() > 0, group


def test_state_and_configuration_give_the_same_model() -> None:
    model, pose = _fitted(), _pose(0.55)
    config = json.loads(json.dumps(model.config))
    again = load_decoder(config, tube(), model.state())
    assert isinstance(again, BlendshapeDecoder)
    assert torch.equal(again.residual(pose), model.residual(pose))


@pytest.mark.parametrize(
    "change",
    [
        {"blendshapes": None},
        {"blendshapes": {"offset": -1, "color": 2, "form": 1, "centres": 8}},
        {"blendshapes": {"offset": 10**9, "color": 2, "form": 1, "centres": 8}},
        {"blendshapes": {"offset": 4, "color": 2, "form": 1, "centres": 8}},
        {"decoder": "magic"},
        {"texels": 3},
    ],
)
def test_a_configuration_that_does_not_fit_is_refused(change: dict[str, object]) -> None:
    model = _fitted()
    with pytest.raises(BadData, match=r"model of layer|blendshapes|fit"):
        load_decoder({**model.config, **change}, tube(), model.state())


def test_an_unknown_decoder_is_a_usage_error() -> None:
    with pytest.raises(UsageProblem, match="magic"):
        new_decoder(tube(), ModelConfig(decoder="magic"), 3)


def test_one_training_pose_is_enough() -> None:
    model = BlendshapeDecoder(tube(), CONFIG, BlendshapeSizes(3, 2, 1, 1))
    model.fit_input(POSES[:1])
    assert torch.isfinite(model.residual(POSES[3])).all()


def test_with_history_the_same_pose_in_other_motion_has_other_coefficients() -> None:
    config = ModelConfig(decoder="blendshapes", ranks=(3, 2, 1), history=2)
    model = new_decoder(tube(), config, len(POSES))
    assert isinstance(model, BlendshapeDecoder)
    length = model.coefficients.motion_scale.shape[0]
    motions = [torch.zeros(length) for _ in POSES]
    for index, motion in enumerate(motions):
        motion[3:10] = 0.5 * (-1) ** index
    model.fit_input(POSES, motions)
    still, moving = model.coefficients(POSES[2]), model.coefficients(POSES[2], motions[2])
    assert not torch.allclose(still, moving, atol=1e-3)
    assert torch.allclose(still, model.coefficients(POSES[2], torch.zeros(length)))
