"""Every loss: an independent value, a finite non-zero gradient, no NaN when its set is empty."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from stages.shared.losses.picture import l1, label_loss, silhouette_loss, ssim, ssim_loss
from stages.shared.losses.surface import (
    covered_skin_loss,
    hand_texels,
    nearest_inner,
    offset_loss,
    opacity_loss,
    penetration_loss,
    seam_loss,
    smooth_loss,
)

_NONE3 = torch.zeros(0, 3)
_NO_PAIRS = torch.zeros(0, 2, dtype=torch.int64)
_NO = torch.zeros(4, dtype=torch.bool)
_ALL = torch.ones(4, dtype=torch.bool)
_CHAIN = torch.tensor([[-1, 1, -1, -1], [-1, 2, -1, 0], [-1, 3, -1, 1], [-1, -1, -1, 2]])
_UP = torch.tensor([[0.0, 0, 1]]).expand(4, 3)


def _noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


FILLED: dict[str, tuple[tuple[int, ...], Callable[[Tensor], Tensor]]] = {
    "l1": ((6, 5, 3), lambda x: l1(x, _noise(6, 5, 3, seed=1))),
    "ssim": ((6, 5, 3), lambda x: ssim_loss(x, _noise(6, 5, 3, seed=1))),
    "label l1": ((6, 5, 2), lambda x: label_loss(x, torch.ones(6, 5, 2), torch.ones(6, 5))),
    "label l2": ((6, 5, 2), lambda x: label_loss(x, torch.ones(6, 5, 2), torch.ones(6, 5), "l2")),
    "silhouette": ((6, 5), lambda x: silhouette_loss(x, torch.ones(6, 5))),
    "penetration": ((4, 3), lambda x: penetration_loss(x * 0.01, x.detach() * 0.01 + 0.002, _UP)),
    "offset": ((4, 3), offset_loss),
    "smooth": ((4, 3), lambda x: smooth_loss(x, _CHAIN)),
    "opacity": ((4,), opacity_loss),
    "seam": ((4, 3), lambda x: seam_loss(x, x, torch.tensor([[0, 1], [2, 3]]))),
    "covered skin": ((4, 3), lambda x: covered_skin_loss(x, ~_first(), _first())),
}
EMPTY: dict[str, tuple[tuple[int, ...], Callable[[Tensor], Tensor]]] = {
    "l1": ((0, 5, 3), lambda x: l1(x, torch.zeros(0, 5, 3))),
    "ssim": ((0, 5, 3), lambda x: ssim_loss(x, torch.zeros(0, 5, 3))),
    "label, nothing known": ((6, 5, 2), lambda x: label_loss(x, torch.ones(6, 5, 2), torch.zeros(6, 5))),
    "label, no layers": ((6, 5, 0), lambda x: label_loss(x, torch.ones(6, 5, 0), torch.ones(6, 5))),
    "silhouette": ((0, 5), lambda x: silhouette_loss(x, torch.ones(0, 5))),
    "penetration, no outer": ((0, 3), lambda x: penetration_loss(x, _noise(4, 3), _UP)),
    "penetration, no inner": ((4, 3), lambda x: penetration_loss(x, _NONE3, _NONE3)),
    "penetration, no violation": ((4, 3), lambda x: penetration_loss(x + 9, x.detach(), _UP)),
    "penetration, no normals": ((4, 3), lambda x: penetration_loss(x, x.detach(), 0 * _UP)),
    "offset": ((0, 3), offset_loss),
    "smooth": ((0, 3), lambda x: smooth_loss(x, torch.zeros(0, 4, dtype=torch.int64))),
    "smooth, no neighbours": ((4, 3), lambda x: smooth_loss(x, torch.full((4, 4), -1))),
    "opacity": ((0,), opacity_loss),
    "seam": ((4, 3), lambda x: seam_loss(x, x, _NO_PAIRS)),
    "covered skin, none covered": ((4, 3), lambda x: covered_skin_loss(x, _NO, _ALL)),
    "covered skin, none seen": ((4, 3), lambda x: covered_skin_loss(x, _ALL, _NO)),
}


def _first() -> Tensor:
    return torch.tensor([True, False, False, False])


@pytest.mark.parametrize("name", FILLED)
def test_gradient_is_there_and_finite(name: str) -> None:
    shape, loss = FILLED[name]
    variable = _noise(*shape).requires_grad_()
    value = loss(variable)
    value.backward()
    assert value.item() > 0 and torch.isfinite(value)
    assert torch.isfinite(variable.grad).all() and variable.grad.abs().sum() > 0


@pytest.mark.parametrize("name", FILLED)
def test_gradient_agrees_with_finite_differences(name: str) -> None:
    shape, loss = FILLED[name]
    variable = _noise(*shape).requires_grad_()
    loss(variable).backward()
    direction = torch.randn(shape, generator=torch.Generator().manual_seed(2))
    step = 2e-3
    if name == "penetration":  # the anchors are held fixed, so the probe must not move them
        anchors = variable.detach() * 0.01 + 0.002

        def loss(x: Tensor) -> Tensor:
            return penetration_loss(x * 0.01, anchors, _UP)

    if name == "covered skin":
        direction[0] = 0.0
    with torch.no_grad():
        ahead, behind = loss(variable + step * direction), loss(variable - step * direction)
    slope = (ahead - behind) / (2 * step)
    assert (variable.grad * direction).sum().item() == pytest.approx(slope.item(), rel=2e-2, abs=2e-4)


@pytest.mark.parametrize("name", EMPTY)
def test_empty_sets_give_zero_and_finite_gradients(name: str) -> None:
    shape, loss = EMPTY[name]
    variable = _noise(*shape).requires_grad_()
    value = loss(variable)
    value.backward()
    assert value.item() == 0
    assert torch.isfinite(variable.grad).all()


def test_ssim_against_scikit_image_away_from_the_border() -> None:
    image, truth = _noise(40, 30, 3), _noise(40, 30, 3, seed=1)
    truth = 0.6 * image + 0.4 * truth
    _, whole = structural_similarity(
        image.numpy(),
        truth.numpy(),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    pad = 40
    canvas = torch.zeros(40 + 2 * pad, 30 + 2 * pad, 3)
    inner = (slice(pad, -pad), slice(pad, -pad))
    canvas_image, canvas_truth = canvas.clone(), canvas.clone()
    canvas_image[inner], canvas_truth[inner] = image, truth
    ours = ssim(canvas_image.double(), canvas_truth.double()).item()
    _, padded = structural_similarity(
        canvas_image.numpy(),
        canvas_truth.numpy(),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    assert ours == pytest.approx(padded.mean(), abs=1e-6)
    assert whole.mean() < 0.99


def test_fast_ssim_equals_the_plain_one_with_its_gradient() -> None:
    truth = _noise(33, 21, 3, seed=1)
    fast = _noise(33, 21, 3).requires_grad_()
    plain = fast.detach().double().requires_grad_()
    first, second = ssim(fast, truth), ssim(plain, truth.double())
    first.backward()
    second.backward()
    assert first.item() == pytest.approx(second.item(), abs=1e-5)
    scale = plain.grad.abs().max()
    assert torch.allclose(fast.grad.double(), plain.grad, atol=2e-4 * scale.item())


def test_penetration_at_a_part_of_the_points_is_the_whole_in_turns() -> None:
    generator = torch.Generator().manual_seed(4)
    outer, inner = (0.02 * torch.randn(32, 3, generator=generator) for _ in range(2))
    normals = torch.nn.functional.normalize(torch.randn(32, 3, generator=generator), dim=1)
    parts = [penetration_loss(outer, inner, normals, every=4, phase=step) for step in range(4)]
    assert len({round(part.item(), 9) for part in parts}) == 4
    whole = penetration_loss(outer, inner, normals)
    assert whole > 0 and torch.stack(parts).mean() == pytest.approx(whole.item(), rel=1e-5)
    assert penetration_loss(outer, inner, normals, every=4, phase=6) == parts[2]


def test_penetration_by_hand() -> None:
    inner = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
    normals = torch.tensor([[0.0, 0, 1], [0.0, 0, 1]])
    outer = torch.tensor([[0.0, 0, 0.002], [1.0, 0, -0.003], [0.0, 0, 0.5], [0.0, 0.05, 0.006]])
    expected = ((0.005 - 0.002) ** 2 + (0.005 + 0.003) ** 2) / 4
    assert penetration_loss(outer, inner, normals).item() == pytest.approx(expected, rel=1e-5)


def test_nearest_inner_is_brute_force() -> None:
    outer, inner = _noise(50, 3), _noise(80, 3, seed=4)
    assert torch.equal(nearest_inner(outer, inner), torch.cdist(outer, inner).argmin(dim=1))


def test_label_and_smooth_by_hand() -> None:
    labels, truth = torch.zeros(1, 2, 2), torch.tensor([[[1.0, 0], [0, 1.0]]])
    known = torch.tensor([[1.0, 0.0]])
    assert label_loss(labels, truth, known).item() == pytest.approx(0.5)
    offsets = torch.tensor([[0.0, 0, 0], [0.001, 0, 0], [0.0, 0, 0], [0.0, 0, 0]])
    # texels: |0-1|², |1-0|², |0-½|², 0, in mm²
    assert smooth_loss(offsets, _CHAIN).item() == pytest.approx((1 + 1 + 0.25) / 4, rel=1e-5)


def test_hands_are_told_by_their_joints() -> None:
    weights = torch.zeros(4, 55)
    weights[0, 20] = weights[1, 3] = weights[2, 54] = weights[3, 22] = 1
    assert hand_texels(weights).tolist() == [True, False, True, False]
    assert len(hand_texels(torch.zeros(0, 55))) == 0
