"""What callers rely on beside the numbers: shapes, refusals, threads, processes, autograd manners."""

from __future__ import annotations

import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from stages.shared.errors import BadData, UsageProblem
from stages.shared.splat import cuda
from stages.shared.splat.api import rasterize
from tests.shared.splat.scenes import FIELDS, Case, compare, random_case

BACKENDS = [
    "reference",
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(cuda.why_not() is not None, reason=str(cuda.why_not()))),
]


def outcome(case: Case, backend: str = "cpu") -> list[Tensor]:
    """Pictures and gradients of one call."""
    leaves = case.with_gradients()
    pictures = leaves.render(backend)
    g = torch.Generator().manual_seed(3)
    loss = torch.zeros(())
    for picture in pictures:
        for field in FIELDS:
            values = getattr(picture, field)
            loss = loss + (values * torch.randn(values.shape, generator=g)).sum()
    grads = torch.autograd.grad(loss, list(leaves.parameters().values()))
    return [getattr(picture, field).detach() for picture in pictures for field in FIELDS] + list(grads)


@pytest.fixture
def threads():
    """Set torch's thread count; put back afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("layers", [0, 2])
def test_same_bytes_for_any_number_of_threads(threads, layers):
    case = random_case(1, n=700, width=150, height=90, cameras=2, layers=layers)
    found = []
    for count in (1, 2, 3, 1):
        threads(count)
        found.append(outcome(case))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_two_threads_may_render_at_once(threads):
    threads(2)
    cases = [random_case(seed, n=400, width=80, height=80) for seed in range(4)]
    alone = [outcome(case) for case in cases]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            for a, b in zip(alone, pool.map(outcome, cases), strict=True):
                assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def _in_child(queue: multiprocessing.Queue, seed: int) -> None:
    queue.put(float(sum(x.double().sum() for x in outcome(random_case(seed, n=300)))))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_works_in_worker_processes(threads, method):
    threads(2)
    wanted = float(sum(x.double().sum() for x in outcome(random_case(5, n=300))))  # the pool exists now
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    threads(1)  # torch's own OpenMP threads do not survive a fork; ours must
    child = context.Process(target=_in_child, args=(queue, 5))
    child.start()
    assert queue.get(timeout=120) == wanted
    child.join()
    assert child.exitcode == 0


def test_no_growth_over_many_calls():
    case = random_case(2, n=60, width=24, height=24)

    def resident() -> int:
        text = Path("/proc/self/statm")
        if not text.exists():
            pytest.skip("no /proc on this system")
        return int(text.read_text().split()[1]) * 4096

    for _ in range(200):
        outcome(case)
    before = resident()
    for _ in range(1000):
        outcome(case)
    assert resident() - before < 8 << 20
    assert threading.active_count() < 20


@pytest.mark.parametrize("backend", BACKENDS)
def test_shapes(backend):
    one = random_case(3, n=5, width=9, height=6).render(backend)[0]
    assert one.features.shape == (6, 9, 3) and one.alpha.shape == one.depth.shape == (6, 9)
    many = random_case(3, n=5, width=9, height=6, cameras=2, layers=3).render(backend)
    assert len(many) == 4
    assert all(p.features.shape == (2, 6, 9, 3) and p.depth.shape == (2, 6, 9) for p in many)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("n, width, height", [(0, 8, 8), (5, 0, 8), (5, 8, 0), (0, 0, 0), (5, 1, 1)])
def test_nothing_to_render(backend, n, width, height):
    case = random_case(4, n=n, layers=2)
    case = replace(case, width=width, height=height)
    for picture in case.render(backend):
        assert picture.features.shape == (height, width, 3)
    grads = outcome(case, backend)[-8:]
    assert all(torch.isfinite(g).all() for g in grads)


@pytest.mark.parametrize("backend", BACKENDS)
def test_nothing_visible_shows_the_background(backend):
    case = random_case(5, n=20)
    away = replace(case, means=case.means + torch.tensor([0.0, 0.0, 500.0]))
    assert case.background is not None
    for picture in away.render(backend):
        assert torch.equal(picture.features, case.background.expand(case.height, case.width, 3))
        assert not picture.alpha.any() and not picture.depth.any() and not picture.expected_depth.any()


def test_strided_and_expanded_inputs():
    case = random_case(6, n=40)
    assert case.scales is not None and case.quats is not None
    wide = torch.zeros(40, 7)
    wide[:, ::2][:, :3] = case.means
    strided = replace(
        case,
        means=wide[:, ::2][:, :3],
        quats=case.quats.T.contiguous().T,
        scales=torch.full((1, 1), 0.1).expand(40, 3),
        opacities=torch.tensor(0.5).expand(40),
        colors=torch.tensor([[0.2, 0.4, 0.6]]).expand(40, 3),
    )
    plain = replace(strided, **{k: v.contiguous() for k, v in strided.parameters().items()})
    for a, b in zip(strided.render("cpu"), plain.render("cpu"), strict=True):
        assert torch.equal(a.features, b.features)
    one_scale = torch.tensor(0.1, requires_grad=True)
    replace(strided, scales=one_scale.expand(40, 3)).render("cpu")[0].alpha.sum().backward()
    assert one_scale.grad is not None and one_scale.grad != 0


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_result_has_the_dtype_of_the_means(backend):
    assert random_case(7, n=5).to(torch.float64).render(backend)[0].features.dtype == torch.float64


def test_no_graph_without_gradients():
    case = random_case(8, n=20).with_gradients()
    with torch.no_grad():
        assert not case.render("cpu")[0].features.requires_grad
    assert not random_case(8, n=20).render("cpu")[0].features.requires_grad


def test_second_derivatives_are_refused():
    case = random_case(9, n=20).with_gradients()
    (grad,) = torch.autograd.grad(case.render("cpu")[0].features.sum(), case.means, create_graph=True)
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(grad.sum(), case.means)


def test_only_the_gradients_asked_for():
    case = random_case(10, n=20)
    colors = case.colors.clone().requires_grad_()
    replace(case, colors=colors).render("cpu")[0].features.sum().backward()
    assert colors.grad is not None and colors.grad.abs().sum() > 0


def test_input_changed_before_backward_is_noticed():
    case = random_case(11, n=20)
    means = case.means.clone().requires_grad_()
    loss = replace(case, means=means).render("cpu")[0].features.sum()
    with torch.no_grad():
        means += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_backward_twice_gives_the_same():
    leaves = random_case(12, n=50).with_gradients()
    loss = leaves.render("cpu")[0].features.sum()
    first = torch.autograd.grad(loss, leaves.means, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(loss, leaves.means)[0])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "name, where, value",
    [
        ("means", (3, 1), float("nan")),
        ("means", (3, 1), float("inf")),
        ("quats", (4, 0), float("nan")),
        ("scales", (5, 2), -float("inf")),
        ("opacities", (6,), float("nan")),
        ("opacities", (6,), 1.5),
        ("opacities", (6,), -0.1),
        ("colors", (7, 1), float("nan")),
        ("viewmats", (1, 2), float("nan")),
        ("Ks", (0, 0), float("inf")),
        ("background", (2,), float("nan")),
    ],
)
def test_bad_numbers_are_refused_by_name_and_index(backend, name, where, value):
    case = random_case(13, n=12)
    array = getattr(case, name).clone()
    array[where] = value
    with pytest.raises(BadData) as caught:
        replace(case, **{name: array}).render(backend)
    index = where if name not in ("viewmats", "Ks", "background") else (0, *where)
    assert caught.value.where == name + "".join(f"[{i}]" for i in index)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_zero_quaternion_is_refused(backend):
    case = random_case(14, n=12)
    assert case.quats is not None
    case.quats[9] = 0
    with pytest.raises(BadData, match=r"quats\[9\]"):
        case.render(backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_negative_variance_is_refused(backend):
    case = random_case(15, n=12)
    covars = torch.eye(3).repeat(12, 1, 1)
    covars[4, 1, 1] = -1e-3
    with pytest.raises(BadData, match=r"covars\[4\]"):
        replace(case, covars=covars, quats=None, scales=None).render(backend)


@pytest.mark.parametrize(
    "change",
    [
        {"quats": None},
        {"covars": torch.eye(3).expand(12, 3, 3)},
        {"means": torch.zeros(12, 2)},
        {"opacities": torch.zeros(12, 1)},
        {"colors": torch.zeros(11, 3)},
        {"viewmats": torch.eye(3)},
        {"background": torch.zeros(4)},
        {"width": -1},
        {"width": 1 << 20},
    ],
    ids=lambda change: next(iter(change)),
)
def test_impossible_shapes_are_refused(change):
    with pytest.raises(UsageProblem):
        replace(random_case(16, n=12), **change).render("cpu")


def test_bad_intrinsics_are_refused():
    case = random_case(17, n=3)
    skew, flat = case.Ks.clone(), case.Ks.clone()
    skew[0, 1], flat[1, 1] = 2.0, 0.0
    with pytest.raises(BadData, match="skew"):
        replace(case, Ks=skew).render("cpu")
    with pytest.raises(BadData, match="focal"):
        replace(case, Ks=flat).render("cpu")


def test_layer_ids_are_checked():
    case = random_case(18, n=6, layers=2)
    with pytest.raises(BadData, match=r"layer_ids\[2\]"):
        replace(case, layer_ids=torch.tensor([0, 1, 2, 0, 1, 0])).render("cpu")
    with pytest.raises(UsageProblem):
        replace(case, layer_ids=torch.zeros(5, dtype=torch.int32)).render("cpu")


@pytest.mark.parametrize(
    "change",
    [{"alone": (0, 2)}, {"alone": (1, 1)}, {"alone": (-1,)}, {"alone_channels": 4}, {"alone_channels": -1}],
)
def test_layers_that_cannot_be_rendered_alone_are_refused(change):
    with pytest.raises(UsageProblem, match="alone"):
        replace(random_case(18, n=6, layers=2), **change).render("cpu")


@pytest.mark.parametrize(
    "option",
    [
        {"near": 0.0},
        {"near": 2.0, "far": 1.0},
        {"eps2d": 0.0},
        {"far": float("nan")},
        {"alpha_min": 0.0},
        {"alpha_min": float("nan")},
        {"transmittance_min": -1e-9},
        {"precision": "half"},
    ],
)
def test_impossible_options_are_refused(option):
    with pytest.raises(UsageProblem):
        random_case(19, n=3).render("cpu", **option)


def test_unknown_backend():
    with pytest.raises(UsageProblem, match="backend"):
        random_case(19, n=3).render("opengl")


@pytest.mark.parametrize("backend", BACKENDS)
def test_background_may_differ_by_camera(backend):
    case = random_case(20, n=0, cameras=2, width=3, height=2)
    background = torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    picture = replace(case, background=background).render(backend)[0]
    assert torch.equal(picture.features[:, 0, 0], background)


@pytest.mark.skipif(cuda.why_not() is not None, reason=str(cuda.why_not()))
def test_cuda_against_the_reference():
    compare(random_case(21), backend="cuda", forward=1e-4, gradient=1e-3)


def test_cuda_says_why_it_cannot():
    if cuda.why_not() is None:
        pytest.skip("a CUDA device is here")
    with pytest.raises(Exception, match="cannot run"):
        random_case(22, n=3).render("cuda")


def test_auto_is_the_cpu_backend_here():
    case = random_case(23, n=30)
    assert case.quats is not None
    arguments = (case.means, case.quats, case.scales, case.opacities, case.colors, case.viewmats, case.Ks)
    a = rasterize(*arguments, case.width, case.height)
    b = rasterize(*arguments, case.width, case.height, backend="cpu")
    assert torch.equal(a.features, b.features)
