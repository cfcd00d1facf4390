"""The CPU backend against the float64 reference: pictures to 1e-5, gradients to 1e-4."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.shared.capture.camera import Camera
from stages.shared.splat import reference
from stages.shared.splat.api import contributions, render_gaussians
from stages.shared.splat.gaussians import Gaussians
from stages.shared.splat.kernels import layout
from tests.shared.splat.scenes import FIELDS, avatar_case, compare, random_case


@pytest.mark.parametrize("seed", range(4))
def test_random_scenes(seed):
    compare(random_case(seed))


@pytest.mark.parametrize("channels", [0, 1, 4, 7, 11])
def test_any_number_of_channels(channels):
    compare(random_case(20 + channels, n=60, channels=channels))


def test_many_gaussians_on_a_surface():
    compare(avatar_case(1))


def test_covariances_instead_of_quaternions_and_scales():
    case = random_case(5)
    assert case.quats is not None and case.scales is not None
    compare(replace(case, covars=reference.covariances(case.quats, case.scales), quats=None, scales=None))


def test_antialiased():
    compare(replace(random_case(6), antialiased=True))


@pytest.mark.parametrize("alpha_min, transmittance_min", [(1e-5, 0.0), (0.05, 0.02)])
def test_cut_offs(alpha_min, transmittance_min):
    case = replace(random_case(26), alpha_min=alpha_min, transmittance_min=transmittance_min)
    compare(case)
    usual = random_case(26).render("cpu")[0].features
    assert (case.render("cpu")[0].features - usual).abs().max() > 1e-4


@pytest.mark.parametrize("layers", [0, 2])
def test_double_precision(layers):
    """Gaussians are still left out by their float32 depth, so the order is the same."""
    case = replace(random_case(27, layers=layers), precision="double")
    compare(case, forward=1e-11, gradient=1e-10)


@pytest.mark.parametrize("layers, antialiased", [(0, False), (2, True)])
def test_gradcheck_of_the_backend_itself(layers, antialiased):
    """Against its own finite differences in float64, away from the cut-offs."""
    case = random_case(15, n=7, width=12, height=10, layers=layers).to(torch.float64)
    case = replace(
        case,
        means=0.1 * case.means,
        scales=0.8 + case.scales,
        opacities=0.2 + 0.3 * case.opacities,
        alpha_min=1e-6,
        transmittance_min=0.0,
        antialiased=antialiased,
        precision="double",
    )
    values = {name: value.detach() for name, value in case.parameters().items()}
    rows = values.pop("viewmats")
    intrinsics = values.pop("Ks")
    leaves = [x.requires_grad_() for x in (*values.values(), rows[:3].clone(), intrinsics[[0, 1], [0, 1]])]

    def pictures(*inputs):
        *plain, pose, focal = inputs
        camera = torch.cat([pose, rows[3:].detach()])
        matrix = intrinsics.detach().index_put((torch.arange(2), torch.arange(2)), focal)
        changed = dict(zip(values, plain, strict=True))
        found = replace(case, **changed, viewmats=camera, Ks=matrix).render("cpu")
        return tuple(getattr(picture, field) for picture in found for field in FIELDS)

    assert torch.autograd.gradcheck(pictures, leaves, fast_mode=True)


def test_layers_in_one_traversal():
    compare(random_case(7, n=150, layers=3))


def test_layers_of_an_opaque_surface():
    case = avatar_case(2, n=1500, size=40)
    compare(replace(case, layer_ids=torch.arange(1500, dtype=torch.int32) % 2, layers=2))


@pytest.mark.parametrize("alone, channels, given", [((1,), 0, 3), ((2, 0), 2, 9), ((), 3, 9)])
def test_only_the_layers_asked_for(alone, channels, given):
    case = random_case(24, n=150, channels=given, layers=3)
    compare(replace(case, alone=alone, alone_channels=channels))


def test_chosen_layers_are_those_of_all():
    """In the order asked for, with the first features; the composite does not notice."""
    case = random_case(25, n=200, channels=9, cameras=2, layers=3)
    composite, *layers = case.render("cpu", median_depth=True)
    got, second, first = replace(case, alone=(2, 0), alone_channels=3).render("cpu", median_depth=True)
    assert torch.equal(second.features, layers[2].features[..., :3])
    assert torch.equal(first.features, layers[0].features[..., :3])
    for a, b in ((composite, got), (layers[2], second), (layers[0], first)):
        for field in ("alpha", "depth", "median_depth"):
            assert torch.equal(getattr(a, field), getattr(b, field))
    assert torch.equal(composite.features, got.features)


def test_batched_cameras():
    compare(random_case(8, cameras=3))


def test_batched_cameras_with_layers():
    compare(random_case(9, n=80, cameras=2, layers=2))


def test_longer_lists_than_one_stretch():
    """More Gaussians over one tile than the kernel takes at a time, faint so that nothing stops early."""
    case = random_case(10, n=900, width=18, height=18)
    compare(
        replace(
            case, opacities=0.02 + 0.02 * case.opacities, means=case.means * 0.2, scales=case.scales * 0.3
        )
    )


def test_eight_lanes(monkeypatch):
    monkeypatch.setattr(layout, "host_lanes", lambda *_: 8)
    compare(random_case(11))
    compare(random_case(12, n=80, layers=2))


@pytest.mark.parametrize("layers", [0, 2])
def test_median_depth(layers):
    case = random_case(13, layers=layers)
    for a, b in zip(
        case.to(torch.float64).render("reference", median_depth=True),
        case.render("cpu", median_depth=True),
        strict=True,
    ):
        assert a.median_depth is not None and b.median_depth is not None
        same = (a.median_depth - b.median_depth).abs() < 1e-4
        assert same.float().mean() > 0.995  # a transmittance at 0.5 may fall to either side
        assert (a.median_depth > 0).any()


def test_layers_equal_separate_renderings():
    case = random_case(14, n=200, layers=3)
    assert case.layer_ids is not None
    together = case.render("cpu")
    whole = replace(case, layers=0)
    apart = [whole.render("cpu")[0]]
    for layer in range(3):
        rows = case.layer_ids == layer
        names = ("means", "quats", "scales", "opacities", "colors")
        apart.append(replace(whole, **{k: getattr(case, k)[rows] for k in names}).render("cpu")[0])
    for a, b in zip(together, apart, strict=True):
        for field in FIELDS:
            assert torch.equal(getattr(a, field), getattr(b, field))


def test_contributions_are_the_sums_of_weights():
    """Of two in line the far one shows what the near one lets through; one behind the camera nothing."""
    means = torch.tensor([[0.0, 0, 2], [0, 0, 4], [0, 0, -2]])
    covariances = torch.tensor([0.25, 1.0, 1.0])[:, None, None] * torch.eye(3)
    intrinsics = np.array([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    camera = Camera("front", 32, 32, intrinsics, np.eye(4))
    gaussians = Gaussians(
        means, covariances, torch.tensor([0.6, 0.5, 0.9]), torch.ones(3, 4), torch.zeros(3).long(), ("body",)
    )
    rows = {name: getattr(gaussians, name)[:1] for name in ("means", "covariances", "opacities")}
    weights = contributions(gaussians, camera)
    near = contributions(replace(gaussians, **rows), camera)
    assert weights[0] == pytest.approx(near[0].item(), rel=1e-6) and weights[2] == 0
    picture = render_gaussians(gaussians, camera)
    assert weights.sum().item() == pytest.approx(picture.alpha.sum().item(), rel=1e-5)
    assert not weights.requires_grad


def test_gradients_match_finite_differences_in_a_smooth_scene():
    """Independent of the reference: a step along the gradient changes the loss as predicted."""
    case = replace(random_case(15, n=12, width=24, height=20), background=None)
    # Wide and in the middle: no pixel is near a cut-off.
    case = replace(
        case, means=0.1 * case.means, scales=0.8 + case.scales, opacities=0.2 + 0.3 * case.opacities
    )
    g = torch.Generator().manual_seed(1)
    weight = torch.randn(20, 24, 3, generator=g, dtype=torch.float64)

    def loss(c):
        return (c.render("cpu")[0].features.double() * weight).sum()

    leaves = case.with_gradients()
    grads = torch.autograd.grad(loss(leaves), list(leaves.parameters().values()))
    for (name, value), grad in zip(case.parameters().items(), grads, strict=True):
        step = 2e-3 * grad / grad.norm().clamp_min(1e-12)
        if name == "viewmats":
            step[3] = 0
        change = loss(replace(case, **{name: value + step})) - loss(replace(case, **{name: value - step}))
        predicted = 2 * (grad.double() * step.double()).sum()
        assert change.item() == pytest.approx(predicted.item(), rel=0.03), name
