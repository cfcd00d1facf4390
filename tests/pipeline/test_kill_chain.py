"""SIGKILL in the middle of the real stages: the same command goes on, and gives what it would have given."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stages.pipeline import BY_NAME, PIPELINE
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.verify import verify
from tests.pipeline.chain import ORDER, REPOSITORY, TINY

pytestmark = pytest.mark.timeout(900)  # the first of these makes the chain


def words_of(stage: str) -> list[str]:
    if stage == "register-template":
        return [stage, "people/subject_1", "-o", "subject", *TINY]
    return [stage, "subject", *TINY]


def start(stage: str, folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "gw_cli", *words_of(stage)],
        cwd=folder,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def kill_and_finish(
    stages: tuple[str, ...], folder: Path, expected: Workspace, kills: int, seed: int
) -> None:
    """Each stage is killed at random times, `kills` altogether, then run to its end."""
    chance = random.Random(seed)
    subject = Workspace(folder / "subject")
    share = max(1, kills // len(stages))
    for stage in stages:
        started = time.monotonic()
        process = start(stage, folder)
        assert process.wait(timeout=280) == 0
        length = time.monotonic() - started
        shutil.rmtree(folder / "subject" / stage)
        for progress in (folder / "subject").glob(f".{stage}.*"):
            shutil.rmtree(progress)
        done = 0
        while done < share:
            process = start(stage, folder)
            time.sleep(chance.uniform(0.1, 1.0) * length)
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                done += 1
            elif subject.current(BY_NAME[stage]) is not None:
                shutil.rmtree(folder / "subject" / stage)  # it was quicker: once more
            process.wait()
            if subject.artifacts():
                assert verify(subject).damaged == []
        assert start(stage, folder).wait(timeout=280) == 0
        assert subject.require(BY_NAME[stage]).digest == expected.require(BY_NAME[stage]).digest, stage
    assert verify(subject).damaged == []


def test_a_killed_stage_goes_on(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "people", tmp_path / "people")
    shutil.copytree(made / "subject", tmp_path / "subject")
    shutil.rmtree(tmp_path / "subject" / "bake-maps")
    kill_and_finish(("bake-maps",), tmp_path, Workspace(made / "subject"), 2, seed=1)


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_forty_kills_over_all_stages(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "people", tmp_path / "people")
    assert tuple(spec.name for spec in PIPELINE) == ORDER
    kill_and_finish(ORDER, tmp_path, Workspace(made / "subject"), 40, seed=2)
