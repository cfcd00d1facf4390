"""Two real processes train what one does: same parameters, one writer, one end."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stages.pipeline import TRAIN
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.capture.native_writer import cameras_json
from stages.shared.errors import GwError
from stages.train import stage
from stages.train.config import PRESETS, TrainConfig
from stages.train.distributed import ALONE, Processes, for_all
from tests.listening import Listener
from tests.stages.train.scenarios import CONFIGS, SHORT
from tests.stages.train.scene import cameras, make_subject

ROOT = Path(__file__).resolve().parents[3]
SECONDS = 280


def torchrun(*words: str) -> subprocess.CompletedProcess[str]:
    """Two processes on this machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo", "PYTHONPATH": str(ROOT)}
    launch = ["-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-addr", "127.0.0.1"]
    return subprocess.run(
        [sys.executable, *launch, "--master-port", str(port), *words],
        env=environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=SECONDS,
    )


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A subject with three training cameras."""
    folder = make_subject(tmp_path_factory.mktemp("three")).parent
    (folder / "capture" / "cameras.json").write_bytes(cameras_json(cameras(), heldout=()))
    return folder


@pytest.fixture(scope="module")
def folder(prepared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every scenario, gone through by two processes."""
    folder = tmp_path_factory.mktemp("scenarios")
    ended = go_through(prepared, folder, "tracked", "nan", "failure", "interrupt")
    assert ended.returncode == 0, ended.stderr[-3000:]
    return folder


@pytest.fixture(scope="module")
def straight(prepared: Path, tmp_path_factory: pytest.TempPathFactory) -> Artifact:
    """What comes of the short run if nothing happens to it."""
    return alone(prepared, tmp_path_factory.mktemp("straight") / "one", SHORT)


def go_through(prepared: Path, folder: Path, *names: str) -> subprocess.CompletedProcess[str]:
    """These scenarios, by two processes."""
    for name in names:
        shutil.copytree(prepared, folder / name)
    return torchrun("-m", "tests.stages.train.scenarios", str(folder), *names)


def alone(prepared: Path, place: Path, config: TrainConfig) -> Artifact:
    """The same by one process, with all the cameras."""
    shutil.copytree(prepared, place)
    return stage.run(place / "subject", for_all(config, Processes(0, 2))).artifact


def notes(folder: Path, name: str) -> list[dict[str, Any]]:
    return [json.loads((folder / name / f"rank-{rank}.json").read_text()) for rank in (0, 1)]


def assert_same(found: Artifact, expected: Artifact, tolerance: float) -> None:
    for layer in ("body", "upper"):
        arrays = expected.arrays(layer)
        assert arrays
        for name, values in arrays.items():
            error = np.abs(found.arrays(layer)[name].astype(np.float64) - values).max(initial=0.0)
            assert error <= tolerance * np.abs(values).max(initial=0.0), (layer, name, error)


def test_the_command_on_two_processes_learns_what_one_learns(prepared: Path, tmp_path: Path) -> None:
    options = ["--preset", "tiny", "--steps", "20", "--views-per-step", "1", "--frame-step", "1", "--json"]
    shutil.copytree(prepared, tmp_path / "two")
    ended = torchrun("-m", "gw_cli", "train", str(tmp_path / "two" / "subject"), *options)
    assert ended.returncode == 0, ended.stderr[-3000:]
    results = [line for line in ended.stdout.splitlines() if line.startswith('{"result"')]
    assert len(results) == 1, "only the first process speaks"
    config = replace(PRESETS["tiny"], steps=20, views_per_step=1, frame_step=1)
    expected = alone(prepared, tmp_path / "one", config)
    found = Workspace(tmp_path / "two" / "subject").require(TRAIN)
    assert found.key == expected.key, "named by the cameras of a step, however many processes drew them"
    assert_same(found, expected, tolerance=0.0)
    lines = [json.loads(line) for line in found.record("metrics.jsonl").splitlines()]
    assert [line["step"] for line in lines] == [9, 19] and lines[-1]["seconds"]["exchange"] > 0


def test_warm_up_and_tracking_come_from_the_first_process(
    folder: Path, prepared: Path, tmp_path: Path
) -> None:
    """Shares of two cameras and one."""
    expected = alone(prepared, tmp_path / "one", CONFIGS["tracked"])
    assert_same(Workspace(folder / "tracked" / "subject").require(TRAIN), expected, tolerance=0.0)
    assert np.abs(expected.arrays("upper")["anchors.offsets"]).max() > 0


@pytest.mark.long
def test_models_that_see_the_camera_agree_too(prepared: Path, tmp_path: Path) -> None:
    assert go_through(prepared, tmp_path, "published").returncode == 0
    expected = alone(prepared, tmp_path / "one", CONFIGS["published"])
    assert_same(Workspace(tmp_path / "published" / "subject").require(TRAIN), expected, tolerance=1e-5)


def test_a_step_that_is_not_finite_in_one_process_is_skipped_by_all(folder: Path) -> None:
    first, second = notes(folder, "nan")
    assert first["ended"] == second["ended"] == "done"
    assert len(first["warnings"]) == 1 and first["warnings"] == second["warnings"]
    assert "step 5" in first["warnings"][0]
    assert Workspace(folder / "nan" / "subject").require(TRAIN).summary["skipped"] == 1


def test_a_failure_in_one_process_ends_all_with_a_checkpoint(folder: Path, straight: Artifact) -> None:
    first, second = notes(folder, "failure")
    assert second["ended"] == "GwError: The picture is damaged."
    assert first["ended"].startswith("OtherStopped")
    _goes_on(folder / "failure" / "subject", straight)


def test_an_interrupt_of_one_process_ends_all_with_a_checkpoint(folder: Path, straight: Artifact) -> None:
    first, second = notes(folder, "interrupt")
    assert first["ended"] == second["ended"] == "interrupted"
    # The step in which the signal came is finished.
    assert first["said"][-1] == "checkpoint written at step 6"
    _goes_on(folder / "interrupt" / "subject", straight)


def _goes_on(subject: Path, expected: Artifact) -> None:
    """From its checkpoint, with one process: a run does not know how many it was begun with."""
    assert Workspace(subject).current(TRAIN) is None
    heard = Listener()
    found = stage.run(subject, for_all(SHORT, Processes(0, 2)), heard)
    assert any(text.startswith("going on from step") for text in heard.said)
    assert_same(found.artifact, expected, tolerance=0.0)


@pytest.mark.long
def test_a_killed_process_leaves_a_checkpoint_behind(
    prepared: Path, tmp_path: Path, straight: Artifact
) -> None:
    assert go_through(prepared, tmp_path, "killed").returncode != 0
    note = json.loads((tmp_path / "killed" / "rank-0.json").read_text())
    assert note["ended"].startswith("OtherStopped")
    _goes_on(tmp_path / "killed" / "subject", straight)


def test_one_process_talks_to_nobody() -> None:
    assert ALONE.turn(3.0, True) == ALONE.turn(3.0, True) and ALONE.turn(3.0).elapsed == 3.0
    assert ALONE.share([1, 2, 3]) == [1, 2, 3]
    shares = [Processes(rank, 3).share(range(7)) for rank in range(3)]
    assert sorted([*shares[0], *shares[1], *shares[2]]) == list(range(7)) and max(map(len, shares)) == 3
    with pytest.raises(GwError), ALONE.failing_together():
        raise GwError("a", "b", "c")
    tensor = torch.ones(2)
    ALONE.spread([tensor])
    assert tensor.tolist() == [1.0, 1.0]
