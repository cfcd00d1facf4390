"""`tests.benchmarks.step`: a split that adds up, and pictures that are the same both ways."""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from typer.testing import CliRunner

from stages.shared.artifacts.canonical import to_json
from stages.shared.errors import UsageProblem
from stages.train.stage import prepare
from tests.benchmarks import step as timing
from tests.benchmarks.step import app
from tests.stages.train.scene import make_subject, tiny


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("timing"))


def test_the_split_adds_up_and_nothing_is_written(subject: Path) -> None:
    before = sorted(subject.rglob("*"))
    found = timing.run(subject, tiny(steps=20), timing.TimingConfig(steps=2, threads=1))
    assert sum(found["phase_seconds"].values()) <= 1.1 * found["step_seconds"]
    assert {"network", "splat", "surface", "data", "optimiser"} <= found["phase_seconds"].keys()
    assert 0 < sum(found["kernel_seconds"].values()) < found["phase_seconds"]["splat"]
    for way in ("shared", "separate"):
        assert min(found["splat_seconds"][way].values()) > 0
    assert found["step_seconds_separate"] > 0
    assert found["gaussians"] > 0 and found["views"] > 0 and found["channels"] == 5
    assert sorted(subject.rglob("*")) == before


def test_both_ways_draw_the_same(subject: Path) -> None:
    composite, cameras = timing._pictures(prepare(subject, tiny(steps=20)), 3)
    for shared, separate in zip(
        timing._shared(composite, cameras[0]), timing._separate(composite, cameras[0]), strict=True
    ):
        assert torch.equal(shared, separate) and shared.amax() > 0


def test_command(subject: Path) -> None:
    found = CliRunner().invoke(
        app, [str(subject), "--preset", "tiny", "--steps", "1", "--threads", "1", "--json"]
    )
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout.splitlines()[-1])["result"]["steps"] == 1


def test_gradients_alone_leave_everything_as_it_is(subject: Path) -> None:
    trainer = prepare(subject, tiny(recompute=True))
    assert all(network.recompute for model in trainer.models.values() for network in model.networks)
    before = {name: parameter.detach().clone() for name, parameter in trainer.parameters.items()}
    with patch.object(trainer, "_update"):
        report = trainer.step(3, 0.0)
    assert report.finite and report.gradient_norm > 0
    assert all(torch.equal(before[name], value) for name, value in trainer.parameters.items())
    assert not trainer.optimizer.state
    assert to_json(tiny(recompute=True)) == to_json(tiny()), "the result is the same, and so is its name"


def test_no_steps_are_refused(subject: Path) -> None:
    with pytest.raises(UsageProblem):
        timing.run(subject, tiny(), timing.TimingConfig(steps=0))
