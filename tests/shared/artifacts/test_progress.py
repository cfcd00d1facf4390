"""Unfinished work is there again after a crash, and gone when it is finished."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.shared.artifacts import Workspace
from stages.shared.errors import BadData
from tests.shared.artifacts.conftest import FIRST, Config, make_first, poses


def test_work_is_kept_until_the_artifact_is_finished(workspace: Workspace, capture: Path) -> None:
    inputs = {"capture/poses": poses(capture)}
    with workspace.progress(FIRST, Config(), inputs) as progress:
        progress.write_arrays("checkpoint.safetensors", {"weights": np.ones(3)}, {"step": 4})
        progress.write_json("plan.json", {"steps": 10})
    with workspace.progress(FIRST, Config(grid=1), inputs) as other:
        assert not other.has("checkpoint.safetensors")
    with workspace.progress(FIRST, Config(), inputs) as progress:
        arrays, note = progress.arrays("checkpoint.safetensors")
        assert note == {"step": 4} and progress.json("plan.json") == {"steps": 10}
        np.testing.assert_array_equal(arrays["weights"], np.ones(3))
        make_first(workspace, capture)
        assert not progress.path.exists()
    assert other.path.exists()


def test_force_starts_anew(workspace: Workspace, capture: Path) -> None:
    inputs = {"capture/poses": poses(capture)}
    with workspace.progress(FIRST, Config(), inputs) as progress:
        progress.write_json("a", 1)
    with workspace.progress(FIRST, Config(), inputs, force=True) as progress:
        assert not progress.has("a")


def test_finished_work_left_by_a_kill_is_removed(workspace: Workspace, capture: Path) -> None:
    inputs = {"capture/poses": poses(capture)}
    artifact = make_first(workspace, capture)
    left = workspace.root / f".first.progress-{artifact.key}"
    left.mkdir()
    with workspace.progress(FIRST, Config(grid=1), inputs) as unfinished:
        assert not left.exists()
    make_first(workspace, capture, Config(grid=2))
    assert unfinished.path.exists()


def test_lines_cut_short_are_left_out(workspace: Workspace, capture: Path) -> None:
    with workspace.progress(FIRST, Config(), {"capture/poses": poses(capture)}) as progress:
        assert progress.lines("metrics.jsonl") == []
        for step in range(3):
            progress.append_line("metrics.jsonl", {"step": step})
        path = progress.path / "metrics.jsonl"
        path.write_bytes(path.read_bytes() + b'{"step": 3')
        assert progress.lines("metrics.jsonl") == [{"step": 0}, {"step": 1}, {"step": 2}]
    with workspace.progress(FIRST, Config(), {"capture/poses": poses(capture)}) as progress:
        progress.append_line("metrics.jsonl", {"step": 3})
        assert progress.lines("metrics.jsonl")[-1] == {"step": 3}
        progress.rewrite_lines("metrics.jsonl", progress.lines("metrics.jsonl")[:2])
        assert progress.lines("metrics.jsonl") == [{"step": 0}, {"step": 1}]


def test_a_flipped_bit_in_a_checkpoint_is_found(workspace: Workspace, capture: Path) -> None:
    with workspace.progress(FIRST, Config(), {"capture/poses": poses(capture)}) as progress:
        progress.write_arrays("c.safetensors", {"weights": np.arange(5.0), "step": np.int64(3)}, {"step": 4})
        path = progress.path / "c.safetensors"
        good = path.read_bytes()
        found = 0
        positions = range(0, len(good) * 8, 7)
        for position in positions:
            data = bytearray(good)
            data[position // 8] ^= 1 << position % 8
            path.write_bytes(data)
            try:
                arrays, note = progress.arrays("c.safetensors")
            except BadData:
                found += 1
            else:  # only padding blanks of the header may differ without a difference in content
                assert note == {"step": 4} and arrays["step"] == 3
                np.testing.assert_array_equal(arrays["weights"], np.arange(5.0))
        assert found > 0.95 * len(positions)


def test_values_that_are_not_finite_never_reach_a_checkpoint(workspace: Workspace, capture: Path) -> None:
    with workspace.progress(FIRST, Config(), {"capture/poses": poses(capture)}) as progress:
        progress.write_arrays("c.safetensors", {"weights": np.ones(2)})
        with pytest.raises(BadData, match="not finite"):
            progress.write_arrays("c.safetensors", {"weights": np.array([1.0, np.nan])})
        np.testing.assert_array_equal(progress.arrays("c.safetensors")[0]["weights"], np.ones(2))
