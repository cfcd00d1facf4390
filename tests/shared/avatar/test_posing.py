"""The fused posing against the plain one: `attributes`, `Replacement.applied` and `pose_layer`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.blendshapes import BlendshapeDecoder, BlendshapeSizes
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.deform import Replacement, pose_layer
from stages.shared.avatar.pose import FramePose
from stages.shared.avatar.posing import PosedBuffers, PosedLayer
from stages.shared.quaternions import matrices_from_quaternions
from tests.shared.avatar.tubes import tube

BETAS = torch.linspace(-2, 2, 10)


def _transforms() -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    transforms = torch.eye(4).repeat(55, 1, 1)
    quaternions = torch.nn.functional.normalize(torch.randn(55, 4, generator=generator), dim=1)
    transforms[:, :3, :3] = matrices_from_quaternions(quaternions)
    transforms[:, :3, 3] = torch.randn(55, 3, generator=generator)
    return transforms


def _model(kind: str) -> Decoder:
    maps, model = tube(), None
    if kind == "blendshapes":
        model = BlendshapeDecoder(maps, ModelConfig(decoder="blendshapes"), BlendshapeSizes(5, 3, 2, 4))
        model.fit_input([_transforms() * (1 + 0.01 * k) for k in range(4)])
    else:
        color = "linear" if kind == "linear" else "sigmoid"
        config = ModelConfig(
            width=0.0625, depth=2, style=8, color=color, max_scale=0.0 if kind == "linear" else 0.03
        )
        model = StyleUNetDecoder(maps, config)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
            parameter.requires_grad_(False)
        model.base_quaternion[7] = 0.0
    return model


def _buffers(count: int) -> PosedBuffers:
    # Views with a stride, as the arrays of a whole outfit are.
    colors = np.full((count, 5), np.nan, np.float32)[:, :3]
    shapes = ((count, 3), (count, 3, 3), (count,))
    return PosedBuffers(*(np.full(shape, np.nan, np.float32) for shape in shapes), colors)


@pytest.mark.parametrize("kind", ["blendshapes", "styleunet", "linear"])
@pytest.mark.parametrize("swaps", [0, 2])
def test_fused_posing_is_the_plain_one(kind: str, swaps: int) -> None:
    model, pose, world = _model(kind), torch.eye(4).repeat(55, 1, 1), _transforms()
    pose[4, :3, :3] = world[4, :3, :3]
    count = len(model.maps)
    generator = torch.Generator().manual_seed(2)
    changes = []
    for _ in range(swaps):
        weights = torch.rand(count, generator=generator).round(decimals=1)
        offsets = 0.02 * torch.randn(count, 3, generator=generator)
        quaternions = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
        changes.append(Replacement(weights, offsets, quaternions))
    if swaps:
        looks = torch.rand(count, 7, generator=generator) * torch.tensor([1.0] * 3 + [0.01] * 3 + [1.0])
        skin = Replacement(
            torch.rand(count, generator=generator),
            0.01 * torch.randn(count, 3, generator=generator),
            torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1),
            looks,
        )
        changes.insert(0, skin)
    with torch.no_grad():
        attributes = model(pose)
        for change in changes:
            attributes = change.applied(attributes)
        plain = pose_layer(model.maps, attributes, world, BETAS)
        out = _buffers(count)
        PosedLayer(model, BETAS, tuple(changes)).pose(FramePose(world, pose, BETAS), out)
    np.testing.assert_allclose(out.means, plain.means, atol=5e-6)
    # A slerp of nearly opposite quaternions is ill-conditioned; elsewhere covariances agree to rounding.
    np.testing.assert_allclose(out.covariances, plain.covariances, atol=2e-7)
    np.testing.assert_allclose(out.opacities, plain.opacities, atol=1e-6)
    np.testing.assert_allclose(out.colors, plain.colors, atol=1e-6)


def test_rows_of_weights_keep_their_sums_without_the_smallest() -> None:
    model = _model("blendshapes")
    weights = model.maps.skin_weights.clone()
    weights[:, 7] = 5e-7
    model.maps = replace(model.maps, skin_weights=weights)
    layer = PosedLayer(model, BETAS)
    first, bones, kept = layer.bones
    sums = np.add.reduceat(kept.astype(np.float64), first[:-1])
    np.testing.assert_allclose(sums, weights.double().sum(dim=1), atol=1e-6)
    assert 7 not in bones


def test_one_and_two_threads_give_the_same_bytes() -> None:
    model, world = _model("blendshapes"), _transforms()
    layer, threads, results = PosedLayer(model, BETAS), torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            out = _buffers(len(model.maps))
            layer.pose(FramePose(world, torch.eye(4).repeat(55, 1, 1), BETAS), out)
            results.append(b"".join(a.tobytes() for a in (out.means, out.covariances, out.colors)))
    finally:
        torch.set_num_threads(threads)
    assert results[0] == results[1]
