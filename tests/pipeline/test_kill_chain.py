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


def kill_and_finish(stage: str, made: Path, folder: Path, kills: int, seed: int) -> None:
    """The stage alone is done again, killed at `kills` random times, then run to its end."""
    shutil.copytree(made / "people", folder / "people")
    shutil.copytree(made / "subject", folder / "subject")
    expected = Workspace(made / "subject").require(BY_NAME[stage]).digest
    chance = random.Random(seed)
    subject = Workspace(folder / "subject")
    shutil.rmtree(folder / "subject" / stage)
    started = time.monotonic()
    assert start(stage, folder).wait(timeout=600) == 0
    length = time.monotonic() - started
    shutil.rmtree(folder / "subject" / stage)
    assert list((folder / "subject").glob(f".{stage}.*")) == []  # or the next run would go on from there
    done = 0
    while done < kills:
        process = start(stage, folder)
        time.sleep(chance.uniform(0.1, 1.0) * length)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            done += 1
        elif subject.current(BY_NAME[stage]) is not None:
            shutil.rmtree(folder / "subject" / stage)  # it was quicker: once more
        process.wait()
        assert verify(subject).damaged == []
    assert start(stage, folder).wait(timeout=600) == 0
    assert subject.require(BY_NAME[stage]).digest == expected
    assert verify(subject).damaged == []


@pytest.mark.long
def test_a_killed_stage_goes_on(made: Path, tmp_path: Path) -> None:
    kill_and_finish("bake-maps", made, tmp_path, 2, seed=1)


@pytest.mark.long
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("stage", ORDER)
def test_eighty_kills_of_every_stage(stage: str, made: Path, tmp_path: Path) -> None:
    """Four hundred over the five stages of a subject."""
    assert tuple(spec.name for spec in PIPELINE) == ORDER
    kill_and_finish(stage, made, tmp_path, 400 // len(ORDER), seed=ORDER.index(stage))
