"""The simulation on paper: its sums, and that it believes run records only."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stages.pipeline import BY_NAME, PIPELINE
from stages.shared.artifacts import Workspace
from tests.benchmarks.scale import ScaleConfig, StageCost, app, simulate


def test_the_sums() -> None:
    costs = [StageCost("a", 600.0, 10**9, 10**6, 1), StageCost("b", 3000.0, 2 * 10**9, 2 * 10**6, 1)]
    config = ScaleConfig(10, 4, 2.0, tryon_seconds=36.0, bundle_bytes=10**8, machines=3)
    found = simulate(costs, config)
    assert found["captures"] == 5 and found["learning_hours"] == pytest.approx(5.0)
    assert found["tryon_hours"] == pytest.approx(0.4)
    assert found["wall_hours"] == pytest.approx(1.8)
    assert found["artifact_gigabytes"] == pytest.approx(0.015)
    assert found["bundle_gigabytes"] == pytest.approx(1.4) and found["most_memory_gigabytes"] == 2.0
    assert simulate(costs, ScaleConfig(2, 4))["captures"] == 4  # every body is learned from a capture too


def test_the_command(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "subject")
    for spec in PIPELINE:
        with workspace.build(
            spec, {}, {name: workspace.require(BY_NAME[name]) for name in spec.reads}
        ) as build:
            build.write_arrays("numbers", {"x": np.arange(3)})
    words = [str(workspace.root), "-o", str(tmp_path / "scale.md"), "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])["result"]
    assert set(found["stages"]) == {spec.name for spec in PIPELINE}
    text = (tmp_path / "scale.md").read_text()
    assert all(f"| {spec.name} |" in text for spec in PIPELINE) and "1000 garments × 100 bodies" in text
    assert CliRunner().invoke(app, [str(tmp_path / "no")]).exit_code == 66
