"""Numbers at the edge of float32: all finite and alpha in [0, 1), or a refusal that names array and row.

Never silent garbage: where the scene is finite, the float64 reference is the judge.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from stages.shared.errors import BadData
from stages.shared.splat.settings import ALPHA_MIN, TRANSMITTANCE_MIN
from tests.shared.splat.scenes import FIELDS, Case, compare, pinhole, random_case

BACKENDS = ("reference", "cpu")


def sane(case: Case, backend: str) -> bool:
    """Render and differentiate: True when all is finite, False when it was refused by name and index."""
    leaves = case.with_gradients()
    try:
        pictures = leaves.render(backend)
    except BadData as refusal:
        assert "[" in refusal.where
        return False
    loss = torch.zeros(())
    for picture in pictures:
        for field in FIELDS:
            values = getattr(picture, field)
            assert torch.isfinite(values).all(), field
            loss = loss + values.float().sum()
        # A pixel that never stops may let so little through that 1 - it rounds to 1.
        below_one = picture.alpha <= 1 if case.transmittance_min == 0 else picture.alpha < 1
        assert (picture.alpha >= 0).all() and below_one.all()
    parameters = leaves.parameters()
    for name, grad in zip(parameters, torch.autograd.grad(loss, list(parameters.values())), strict=True):
        assert torch.isfinite(grad).all(), f"gradient of {name}"
    return True


def small(n: int = 24) -> Case:
    return random_case(40, n=n, width=20, height=18)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("length", [1e-30, 1e-12, 1.0, 1e12, 1e30])
def test_quaternions_of_any_length(backend, length):
    case = small()
    assert case.quats is not None
    unit = case.quats / case.quats.norm(dim=1, keepdim=True)
    scaled = replace(case, quats=unit * length)
    assert sane(scaled, backend) == (length > 1e-15)
    if length > 1e-15:
        a, b = (replace(case, quats=q).render(backend)[0] for q in (unit, unit * length))
        torch.testing.assert_close(a.features, b.features, atol=2e-5, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("angle", [0.0, math.pi - 1e-7, math.pi, 2 * math.pi])
def test_rotations_at_the_turning_points(backend, angle):
    case = small()
    quats = torch.tensor([[math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]]).expand(24, 4)
    assert sane(replace(case, quats=quats), backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("scale", [1e-30, 1e-9, 1e-3, 10.0, 1e3, 1e6])
def test_scales_from_nothing_to_a_city(backend, scale):
    case = small()
    assert sane(replace(case, scales=torch.full((24, 3), scale)), backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_needles(backend, axis):
    case = small()
    scales = torch.full((24, 3), 1e-4)
    scales[:, axis] = 1.0
    assert sane(replace(case, scales=scales), backend)


def test_needles_are_accurate():
    """Aspect 1e4 at every angle: the conic and the falloff keep their digits."""
    case = small(16)
    turn = torch.linspace(0, math.pi, 16)
    quats = torch.stack([(turn / 2).cos(), torch.zeros(16), torch.zeros(16), (turn / 2).sin()], 1)
    means = 0.3 * case.means
    scales = torch.tensor([[1.0, 1e-4, 1e-4]]).expand(16, 3)
    compare(replace(case, quats=quats, scales=scales, means=means, viewmats=plain_view()), forward=2e-5)


def plain_view(distance: float = 3.0) -> Tensor:
    view = torch.eye(4)
    view[2, 3] = distance
    return view


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("opacity", [0.0, 1e-12, 1 / 255, 0.5, 1 - 1e-12, 1.0])
def test_opacities(backend, opacity):
    assert sane(replace(small(), opacities=torch.full((24,), opacity)), backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("z", [-1e6, -3.0, -1e-3, 0.0, 1e-30, 1e-3, 0.0101, 3.0, 1e6, 1e18, 1e30])
def test_gaussians_at_any_depth(backend, z):
    case = replace(small(), viewmats=torch.eye(4))
    means = case.means.clone()
    means[:, 2] = z
    assert sane(replace(case, means=means), backend)
    assert sane(replace(case, means=means * torch.tensor([0.0, 0.0, 1.0])), backend)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("focal", [1e-3, 1.0, 1e5])
def test_focal_lengths(backend, focal):
    case = small()
    for scale in (1e-3, 1.0, 1e3):
        scales = torch.full((24, 3), scale)
        assert sane(replace(case, Ks=pinhole(20, 18, focal).float(), scales=scales), backend)


@pytest.mark.parametrize("width, height", [(1, 1), (8192, 1), (1, 8192), (8192, 40)])
def test_image_sizes(width, height):
    case = replace(small(), width=width, height=height, Ks=pinhole(width, height, 0.7 * width).float())
    assert sane(case, "cpu")
    if width * height < 10000:
        compare(case, forward=2e-5)


def test_everything_on_one_pixel():
    n = 3000
    case = replace(
        random_case(41, n=n, width=16, height=16),
        means=torch.zeros(n, 3),
        scales=torch.full((n, 3), 1e-6),
        viewmats=plain_view(),
        opacities=torch.full((n,), 0.01),
    )
    assert sane(case, "cpu")
    compare(case, gradient=1e-3)  # thousands of nearly equal terms cancel in what lies behind


def test_a_million_on_one_tile():
    n = 1_000_000
    g = torch.Generator().manual_seed(2)
    case = replace(
        random_case(42, n=1, width=16, height=16),
        means=0.2 * torch.rand(n, 3, generator=g),
        quats=torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4),
        scales=torch.tensor([[0.01]]).expand(n, 3),
        opacities=torch.rand(n, generator=g) * 0.02,
        colors=torch.rand(n, 3, generator=g),
        viewmats=plain_view(),
    )
    assert sane(case, "cpu")


def test_one_over_the_whole_picture():
    case = replace(
        small(1), means=torch.zeros(1, 3), scales=torch.full((1, 3), 50.0), width=2000, height=1000
    )
    assert sane(case, "cpu")


def test_too_many_entries_are_refused_before_memory_is_taken():
    n = 20_000
    case = replace(
        random_case(43, n=n, channels=1),
        means=torch.zeros(n, 3),
        scales=torch.full((n, 3), 1e3),
        width=8192,
        height=8192,
    )
    with pytest.raises(BadData, match="tiles"):
        case.render("cpu")


@pytest.mark.parametrize("backend", BACKENDS)
def test_covariances_that_rounding_made_indefinite(backend):
    case = small()
    generator = torch.Generator().manual_seed(1)
    axis = torch.nn.functional.normalize(torch.randn(24, 3, generator=generator), dim=1)
    flat = (axis[:, :, None] * axis[:, None]) * 1e6  # rank one; rounding leaves negative eigenvalues
    assert torch.linalg.eigvalsh(flat).min() < 0
    assert sane(replace(case, covars=flat, quats=None, scales=None), backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_empty_layers_and_a_layer_of_one(backend):
    case = random_case(44, n=10, layers=3)
    ids = torch.zeros(10, dtype=torch.int32)
    ids[4] = 2
    pictures = replace(case, layer_ids=ids).render(backend)
    assert not pictures[2].alpha.any()
    assert sane(replace(case, layer_ids=ids), backend)


def test_colours_may_be_huge_or_negative():
    case = small()
    assert sane(replace(case, colors=case.colors * 1e30 - 5e29), "cpu")


# Fuzz: entries drawn from lists of awkward numbers; most scenes are finite, some must be refused.

AWKWARD = np.array(
    [0.0, -0.0, 1e-45, 1e-38, 1e-9, 1e-3, 0.5, 1.0, 3.0, 1e3, 1e6, 1e18, 3e38, np.inf, np.nan], np.float32
)


def fuzzed(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 40))
    layers = int(rng.integers(0, 3))
    case = random_case(
        seed, n=n, channels=3, width=int(rng.integers(1, 40)), height=int(rng.integers(1, 40)), layers=layers
    )

    def spoil(array: Tensor, share: float, highest: int) -> Tensor:
        values = array.numpy().copy()
        hit = rng.uniform(size=values.shape) < share
        signs = rng.choice([-1, 1], size=values.shape)
        values[hit] = (AWKWARD[rng.integers(0, highest, values.shape)] * signs)[hit]
        return torch.from_numpy(values)

    top = len(AWKWARD) if rng.uniform() < 0.2 else len(AWKWARD) - 3
    share = rng.choice([0.0, 0.02, 0.2, 0.9])
    assert case.quats is not None and case.scales is not None
    case = replace(
        case,
        means=spoil(case.means, share, top),
        quats=spoil(case.quats, share, top),
        scales=spoil(case.scales, share, top),
        opacities=spoil(case.opacities, share, top).abs().clamp_max(1.0 if top < len(AWKWARD) else math.inf),
        Ks=pinhole(case.width, case.height, float(rng.choice([1e-2, 1.0, 30.0, 1e5]))).float(),
        antialiased=bool(rng.integers(0, 2)),
        alpha_min=float(rng.choice([1e-6, ALPHA_MIN, 0.3])),
        transmittance_min=float(rng.choice([0.0, TRANSMITTANCE_MIN, 0.3])),
    )
    return case


def fuzz(seeds: range) -> None:
    drawn, refused = 0, 0
    for seed in seeds:
        case = fuzzed(seed)
        try:
            fine = sane(case, "cpu")
        except AssertionError as failure:
            raise AssertionError(f"scene {seed}: {failure}") from failure
        drawn, refused = drawn + fine, refused + (not fine)
        if not fine:
            with pytest.raises(BadData):
                case.render("reference")
    assert drawn > refused > 0


def test_fuzz():
    fuzz(range(400))


@pytest.mark.long
def test_fuzz_five_thousand():
    fuzz(range(1000, 6500))
