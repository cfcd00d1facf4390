"""`python -m tests.benchmarks.splat`: what it counts is right, what it writes can be read."""

from __future__ import annotations

import json
import mmap
import xml.etree.ElementTree as xml

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from stages.shared.errors import UsageProblem
from stages.shared.splat import reference
from stages.shared.splat.api import rasterize
from stages.shared.splat.kernels import layout
from stages.shared.splat.settings import SplatSettings
from tests.benchmarks.splat.__main__ import app
from tests.benchmarks.splat.chart import Series, chart
from tests.benchmarks.splat.figure import make_camera, make_figure
from tests.benchmarks.splat.limit import measure_limit
from tests.benchmarks.splat.measure import Case, measure
from tests.benchmarks.splat.memory import peak_bytes
from tests.benchmarks.splat.peers import gsplat_torch, why_no_gsplat
from tests.benchmarks.splat.run import BenchConfig, run


@pytest.fixture(scope="module")
def limit():
    return measure_limit(3, layout.host_lanes())


def test_counted_pairs_are_those_of_the_reference(limit):
    case = Case(800, 40, 3)
    found = measure(case, 1, limit)
    figure = make_figure(case.gaussians, case.channels)
    view, intrinsics = (x.double() for x in make_camera(case.size))
    covars = reference.covariances(figure.quats.double(), figure.scales.double())
    gaussians = reference.project(
        figure.means.double(), covars, figure.opacities.double(), view, intrinsics, 40, 40, SplatSettings()
    )
    row, column = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    alpha = reference.alphas(gaussians, torch.stack([column, row], -1).reshape(-1, 2).double())
    weights, _ = reference.weights(alpha)
    assert found["pairs"] == pytest.approx(int((weights > 0).sum()), rel=2e-3)
    assert 0 < found["forward_lane_use"] <= found["backward_lane_use"] <= 1
    assert found["buffer_bytes"] > 0
    assert set(found["phase_milliseconds"]) >= {"project", "blend", "blend_backward", "project_backward"}


def test_limit_is_plausible(limit):
    """A core does between a tenth and a thousand billion operations a second, a step takes nanoseconds."""
    assert 1e8 < limit.flops_per_second < 2e12
    assert 0.1 < limit.forward_nanoseconds < 1e3 and 0.1 < limit.backward_nanoseconds < 1e3


def test_figure_is_seeded_and_person_sized():
    a, b = make_figure(3000, 4, seed=3), make_figure(3000, 4, seed=3)
    assert all(torch.equal(x, y) for x, y in zip(vars(a).values(), vars(b).values(), strict=True))
    low, high = a.means[:, 1].min(), a.means[:, 1].max()
    assert -0.05 < low < 0.1 and 1.7 < high < 1.85
    assert a.colors.shape == (3000, 4)
    np.testing.assert_allclose(a.quats.norm(dim=1), 1, atol=1e-5)


def test_run_writes_json_and_charts(tmp_path):
    before = torch.get_num_threads()
    result = run(tmp_path, BenchConfig((200, 400), (24, 48), (3,), rounds=1, threads=2, cold=False))
    assert torch.get_num_threads() == before
    assert [path.name for path in result.files] == ["splat.json", "splat_gaussians.svg", "splat_pixels.svg"]
    stored = json.loads(result.files[0].read_text())
    assert len(stored["cases"]) == 4 and stored["threads"] == 2
    for path in result.files[1:]:
        root = xml.fromstring(path.read_text())
        assert len(root.findall("{http://www.w3.org/2000/svg}polyline")) == 2  # forward, both
    first = stored["first_call"]
    assert first["new_process"]["seconds"] > 0 and first["new_process_empty_cache"] is None
    assert not first["new_process"]["compiled"]  # this process has left its code on disk
    assert stored["times_faster_than_reference"] > 0
    assert (stored["times_faster_than_gsplat_torch"] is None) == ("skipped" in stored["gsplat_torch"])


def test_peak_memory_is_that_of_the_process():
    def allocate() -> None:
        with mmap.mmap(-1, 40 << 20) as room:  # of its own: freed memory may still be resident
            room.write(bytes(40 << 20))

    found = peak_bytes(allocate)
    if found["peak_bytes"] is None:
        pytest.skip("no /proc/self/clear_refs on this system")
    assert found["peak_growth_bytes"] > 35 << 20 and found["peak_bytes"] > found["peak_growth_bytes"]
    after = peak_bytes(lambda: None)
    assert after["peak_growth_bytes"] < 5 << 20  # the old peak is forgotten


@pytest.mark.skipif(why_no_gsplat() is not None, reason=str(why_no_gsplat()))
def test_gsplat_in_torch_shows_the_same_picture():
    figure, (view, intrinsics) = make_figure(300, 3), make_camera(32)
    camera = (view, intrinsics, 32, 32)
    peer = gsplat_torch(figure, *camera, torch.ones(3))
    shape = (figure.means, figure.quats, figure.scales, figure.opacities, figure.colors)
    ours = rasterize(*shape, *camera, background=torch.ones(3))
    for field in ("features", "alpha", "depth"):
        assert (getattr(peer, field) - getattr(ours, field)).abs().mean() < 1e-4


def test_chart_places_points_on_logarithmic_axes():
    text = chart("t", "x", "y", [Series("a < b", [(1, 1), (10, 10), (100, 100)])])
    line = xml.fromstring(text).find("{http://www.w3.org/2000/svg}polyline")
    assert line is not None
    points = [tuple(map(float, pair.split(","))) for pair in line.attrib["points"].split()]
    assert points[1][0] - points[0][0] == pytest.approx(points[2][0] - points[1][0], abs=0.2)
    assert points[0][1] - points[1][1] == pytest.approx(points[1][1] - points[2][1], abs=0.2)


def test_command_in_json():
    found = CliRunner().invoke(
        app,
        ["--gaussians", "0.2k", "--sizes", "24", "--channels", "3", "--rounds", "1"]
        + ["--no-cold", "--json"],
    )
    assert found.exit_code == 0
    last = json.loads(found.stdout.strip().splitlines()[-1])["result"]
    assert last["cases"][0]["gaussians"] == 200
    assert last["cases"][0]["forward_milliseconds"] > 0


def test_what_cannot_be_measured_is_refused():
    assert CliRunner().invoke(app, ["--gaussians", "many"]).exit_code == 2
    with pytest.raises(UsageProblem):
        run(None, BenchConfig((0,)))
