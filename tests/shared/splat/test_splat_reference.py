"""The reference against closed forms, hand-made scenes and finite differences."""

from __future__ import annotations

import math

import pytest
import torch

from stages.shared.splat import reference
from stages.shared.splat.api import rasterize
from stages.shared.splat.settings import ALPHA_MAX, SplatSettings
from tests.shared.splat.scenes import random_case

D = torch.float64
FOCAL = 50.0
BACKENDS = ("reference", "cpu")


def one(
    mean,
    sigma,
    opacity,
    color,
    backend,
    size=(21, 17),
    dtype=D,
    focal=FOCAL,
    principal=None,
    background=None,
    **options,
):
    """Round Gaussians in front of a camera at the origin; first axis of every argument is the Gaussian."""
    width, height = size
    mean = torch.tensor(mean, dtype=dtype).reshape(-1, 3)
    n = len(mean)
    k = torch.eye(3, dtype=dtype)
    k[0, 0] = k[1, 1] = focal
    k[0, 2], k[1, 2] = principal or (width / 2, height / 2)
    return rasterize(
        mean,
        torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).expand(n, 4),
        torch.tensor(sigma, dtype=dtype).reshape(n, 1).expand(n, 3),
        torch.tensor(opacity, dtype=dtype).reshape(n),
        torch.tensor(color, dtype=dtype).reshape(n, -1),
        torch.eye(4, dtype=dtype),
        k,
        width,
        height,
        backend=backend,
        background=background,
        settings=SplatSettings(**options),
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_gaussian_in_closed_form(backend):
    z, sigma, opacity = 2.0, 0.11, 0.8
    picture = one([0.0, 0.0, z], sigma, opacity, [0.2, 0.5, 0.9], backend, background=torch.ones(3, dtype=D))
    variance = (FOCAL * sigma / z) ** 2 + 0.3
    row, column = torch.meshgrid(torch.arange(17) + 0.5 - 8.5, torch.arange(21) + 0.5 - 10.5, indexing="ij")
    alpha = opacity * torch.exp(-0.5 * (row**2 + column**2).double() / variance)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    torch.testing.assert_close(picture.alpha, alpha, atol=1e-6, rtol=0)
    torch.testing.assert_close(picture.depth, alpha * z, atol=1e-6, rtol=0)
    blue = alpha * 0.9 + (1 - alpha)
    torch.testing.assert_close(picture.features[..., 2], blue, atol=1e-6, rtol=0)
    torch.testing.assert_close(
        picture.expected_depth, torch.where(alpha > 0, z, 0.0).double(), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_nearer_covers_farther_whatever_the_order(backend):
    for order in ([0, 1], [1, 0]):
        mean = torch.tensor([[0.0, 0, 2.0], [0.0, 0, 3.0]])[order].tolist()
        color = torch.tensor([[1.0], [10.0]])[order].tolist()
        opacity = torch.tensor([0.6, 0.7])[order].tolist()
        picture = one(mean, [0.5, 0.75], opacity, color, backend, size=(9, 9))
        assert picture.features[4, 4, 0].item() == pytest.approx(0.6 * 1 + 0.4 * 0.7 * 10, abs=1e-4)
        assert picture.alpha[4, 4].item() == pytest.approx(1 - 0.4 * 0.3, abs=1e-5)
        assert picture.depth[4, 4].item() == pytest.approx(0.6 * 2 + 0.4 * 0.7 * 3, abs=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_depths_keep_their_order(backend):
    picture = one([[0.0, 0, 2.0]] * 2, [0.5] * 2, [0.6, 0.7], [[1.0], [10.0]], backend, size=(9, 9))
    assert picture.features[4, 4, 0].item() == pytest.approx(0.6 + 0.4 * 0.7 * 10, abs=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixel_centres_are_at_integer_plus_one_half(backend):
    # f X / Z + c = 50 * 0.1 / 2 + 4 = 6.5: the middle of column 6; row 3.
    picture = one([0.1, 0.0, 2.0], 1e-6, 0.9, [1.0], backend, size=(12, 8), principal=(4.0, 3.5))
    assert divmod(int(picture.alpha.argmax()), 12) == (3, 6)
    assert picture.alpha[3, 6].item() == pytest.approx(0.9, abs=1e-5)
    left, right = picture.alpha[3, 5].item(), picture.alpha[3, 7].item()
    assert left == pytest.approx(right, abs=1e-5)
    assert left == pytest.approx(0.9 * math.exp(-0.5 / 0.3), abs=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_alpha_is_clamped_and_a_pixel_stops(backend):
    # One opaque Gaussian leaves 0.001; the second would leave 1e-6 < 1e-4, so that it is not blended.
    picture = one([[0.0, 0, 2.0], [0, 0, 3.0]], [0.5, 0.5], [1.0, 1.0], [[1.0], [5.0]], backend, size=(9, 9))
    assert picture.alpha[4, 4].item() == pytest.approx(ALPHA_MAX, abs=1e-6)
    assert picture.features[4, 4, 0].item() == pytest.approx(ALPHA_MAX, abs=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_median_depth(backend):
    depths = [[0.0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]]
    picture = one(
        depths, [0.6, 0.9, 1.2], [0.3, 0.4, 0.9], [[1.0]] * 3, backend, size=(9, 9), median_depth=True
    )
    assert picture.median_depth is not None
    assert picture.median_depth[4, 4].item() == pytest.approx(3.0)  # 0.7 -> 0.42
    alone = one([0.0, 0, 2.0], 0.6, 0.3, [1.0], backend, size=(9, 9), median_depth=True)
    assert alone.median_depth is not None
    assert alone.median_depth[4, 4].item() == 0.0


@pytest.mark.parametrize("backend", BACKENDS)
def test_near_and_far_leave_out(backend):
    depths = [[0.0, 0, 0.5], [0, 0, 3.0], [0, 0, 9.0]]
    picture = one(depths, [0.3] * 3, [0.5] * 3, [[1.0]] * 3, backend, size=(9, 9), near=0.6, far=8.0)
    assert picture.depth[4, 4].item() == pytest.approx(1.5, abs=1e-4)


def test_antialiased_keeps_the_energy_of_a_small_gaussian():
    sharp = one([0.0, 0, 2.0], 0.01, 0.9, [1.0], "reference", antialiased=True)
    sigma2 = (FOCAL * 0.01 / 2) ** 2
    assert sharp.alpha[8, 10].item() == pytest.approx(0.9 * sigma2 / (sigma2 + 0.3), rel=1e-6)


def test_covariance_of_a_turned_box():
    # A quarter turn about z swaps the first two axes.
    half = math.sqrt(0.5)
    covariance = reference.covariances(
        torch.tensor([[half, 0, 0, half]], dtype=D), torch.tensor([[1.0, 2.0, 3.0]], dtype=D)
    )
    torch.testing.assert_close(covariance[0], torch.diag(torch.tensor([4.0, 1.0, 9.0], dtype=D)))


@pytest.mark.parametrize("form", ["quats", "covars", "antialiased"])
def test_gradients_match_finite_differences(form):
    case = random_case(3, n=6, width=7, height=6).to(D)
    assert case.quats is not None and case.scales is not None
    covars = reference.covariances(case.quats, case.scales * 3)

    def run(means, quats, scales, covars, opacities, colors, pose, lens, background):
        view = torch.cat([pose, torch.tensor([[0.0, 0, 0, 1]], dtype=D)])
        intrinsics = torch.zeros(3, 3, dtype=D).index_put(
            (torch.tensor([0, 1, 0, 1]), torch.tensor([0, 1, 2, 2])), lens
        )
        if form == "covars":
            quats = scales = None
            covars = covars + covars.mT
        else:
            covars = None
        picture = rasterize(
            means, quats, scales, opacities, colors, view, intrinsics, 7, 6, covars=covars,
            background=background, backend="reference",
            settings=SplatSettings(antialiased=form == "antialiased"),
        )  # fmt: skip
        return picture.features, picture.alpha, picture.depth

    inputs = (
        case.means * 0.2, case.quats, case.scales * 3, covars, case.opacities, case.colors, case.viewmats[:3],
        0.2 * case.Ks[[0, 1, 0, 1], [0, 1, 2, 2]], case.background,
    )  # fmt: skip
    leaves = tuple(x.detach().clone().requires_grad_() for x in inputs if x is not None)
    assert torch.autograd.gradcheck(run, leaves, eps=1e-7, atol=1e-5, rtol=1e-4)
