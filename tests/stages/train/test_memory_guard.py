"""Memory that does not suffice is said before, and named after."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gw_cli.child import run_command
from stages.shared.artifacts import files
from stages.shared.avatar.config import PAPER_MODEL
from stages.shared.errors import StorageFailure, UsageProblem
from stages.train import estimate, stage
from stages.train.config import PRESETS, TrackConfig
from stages.train.estimate import (
    cure,
    extent_of,
    memory_bytes,
    memory_named,
    refuse_if_scarce,
)
from stages.train.stage import prepare
from stages.train.trainer import Trainer
from tests.stages.train.scene import TINY, make_subject, tiny


def test_scarce_memory_is_refused_with_what_fits() -> None:
    fixes = {"--recompute": 2_500_000_000, "--preset draft": 1_500_000_000}
    with pytest.raises(UsageProblem, match=r"3\.0 GB of memory, and 2\.0 GB are free") as caught:
        refuse_if_scarce(3_000_000_000, 2_000_000_000, lambda: fixes)
    assert caught.value.fix == "Use --preset draft, which needs about 1.5 GB."
    assert "another machine" in cure(fixes, 1_000_000_000)
    for available in (None, 4_000_000_000):
        refuse_if_scarce(3_000_000_000, available, dict)


def test_a_run_that_cannot_fit_is_refused_before_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = make_subject(tmp_path)
    monkeypatch.setattr(estimate, "available_bytes", lambda: 700_000_000)
    huge = tiny(model=replace(PAPER_MODEL, width=0.5, depth=4))
    with pytest.raises(UsageProblem, match="GB are free") as caught:
        stage.run(subject, huge)
    assert "Use --preset balanced" in caught.value.fix
    assert not list(subject.glob(".train*"))


def test_a_disk_too_full_is_refused_before_it_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subject = make_subject(tmp_path)
    monkeypatch.setattr(files, "free_bytes", lambda path: 1000)
    with pytest.raises(StorageFailure, match="1000 bytes free"):
        stage.run(subject, tiny())
    assert not list(subject.glob(".train*"))


def test_a_run_takes_the_memory_that_was_foretold(tmp_path: Path) -> None:
    """The peak of a process of its own, as it is recorded; at this size it is all libraries."""
    subject = make_subject(tmp_path)
    found = run_command("train", subject, "--preset", "tiny", "--steps", "3")
    planned = stage.plan(subject, replace(PRESETS["tiny"], steps=3)).memory_bytes
    recorded = json.loads((Path(found.result["artifact"]) / "run.json").read_bytes())["peak_bytes"]
    assert planned is not None and 0.8 < planned / recorded < 1.25, (planned, recorded)


def test_what_is_learned_is_counted_to_the_number(tmp_path: Path) -> None:
    """Anchors of tracked frames, networks and view networks, base attributes."""
    subject = make_subject(tmp_path)
    published = replace(PAPER_MODEL, width=0.0625, depth=2, style=8)
    tracked = tiny(track=TrackConfig(frame_step=1), model=replace(TINY.model, anchors=9))
    for config in (tiny(), tracked, tiny(model=published)):
        trainer = prepare(subject, config)
        costs = [model.cost(model.maps, trainer.config.model) for model in trainer.models.values()]
        assert sum(cost.parameters for cost in costs) == sum(
            parameter.numel() for parameter in trainer.parameters.values()
        )


def test_estimates_grow_with_what_is_kept(tmp_path: Path) -> None:
    subject = make_subject(tmp_path)
    trainer = prepare(subject, tiny())
    maps = {name: model.maps for name, model in trainer.models.items()}
    wide = tiny(model=replace(PAPER_MODEL, width=1.0, depth=4))
    extent = extent_of(trainer.views.sequence, wide)
    whole, economical = (memory_bytes(maps, replace(wide, recompute=on), extent) for on in (False, True))
    assert economical < whole
    more = replace(extent, read=100, pixels=1_000_000)
    assert memory_bytes(maps, wide, more) - whole > 100 * extent.cameras * 1_000_000 * 5
    assert replace(more, followed=3).tracked_views == 3 * extent.cameras


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        torch.OutOfMemoryError("CUDA out of memory."),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried 9 bytes."),
    ],
)
def test_running_out_names_a_cure(error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Trainer, number: int, elapsed: float) -> None:
        raise error

    monkeypatch.setattr(Trainer, "step", fail)
    with pytest.raises(UsageProblem, match="Memory ran out") as caught:
        stage.run(make_subject(tmp_path), tiny())
    assert caught.value.fix


def test_other_errors_stay_what_they_are() -> None:
    with pytest.raises(RuntimeError, match="shapes"), memory_named(1, dict):
        raise RuntimeError("shapes do not fit")
