"""Every reader under thousands of spoiled files: an object, or an error that names file and cure."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from stages.shared.errors import GwError
from tests.hostile.readers import READERS

REPOSITORY = Path(__file__).resolve().parents[2]
REGRESSIONS = sorted((Path(__file__).parent / "regressions").glob("*-*"))
CI_RUNS, NIGHTLY_RUNS = 1_000, 100_000


def fuzz(reader: str, runs: int, crashes: Path, *options: str, seconds: float) -> dict[str, dict[str, float]]:
    words = [reader, "--runs", str(runs), "--crashes", str(crashes), *options]
    done = subprocess.run(
        [sys.executable, "-m", "tests.hostile.fuzz", *words],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found: dict[str, dict[str, float]] = {}
    for line in done.stdout.splitlines():
        if line.startswith("{"):
            found |= json.loads(line)
    return found


def test_spoiled_files(tmp_path: Path) -> None:
    found = fuzz("all", CI_RUNS, tmp_path, seconds=250)
    assert set(found) == set(READERS)
    for name, counts in found.items():
        assert counts["runs"] == CI_RUNS and counts["refused"] > CI_RUNS // 20, name


@pytest.mark.parametrize("name", READERS)
def test_good_files_are_read(name: str, tmp_path: Path) -> None:
    """The fuzzing begins from what the reader takes."""
    reader = READERS[name]
    folder = tmp_path / "e3b0c44298fc1c149afbf4c8996fb924"
    folder.mkdir()
    (folder / reader.file).write_bytes(reader.file_of(reader.good()))
    try:
        assert reader.read(folder / reader.file) is not None
    except GwError as error:
        assert name == "manifest" and "folder it is in" in error.what


@pytest.mark.parametrize("path", REGRESSIONS, ids=lambda path: path.name)
def test_what_once_broke_a_reader(path: Path, tmp_path: Path) -> None:
    reader = READERS[path.name.rpartition("-")[0]]
    (tmp_path / reader.file).write_bytes(path.read_bytes())
    try:
        reader.read(tmp_path / reader.file)
    except GwError as error:
        assert error.where


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", READERS)
def test_a_hundred_thousand_guided(name: str, tmp_path: Path) -> None:
    """Twelve readers: more than a million executions together."""
    if importlib.util.find_spec("atheris") is None:
        pytest.skip("atheris is not installed (extra `fuzz`)")
    found = fuzz(name, NIGHTLY_RUNS, tmp_path, "--guided", seconds=3500)
    assert found[name]["runs"] >= NIGHTLY_RUNS
