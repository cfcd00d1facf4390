"""The emitted workflow: every stage, in the order of the table; Snakemake plans and runs it."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.pipeline import PIPELINE

REPOSITORY = Path(__file__).resolve().parents[3]
needs_snakemake = pytest.mark.skipif(
    importlib.util.find_spec("snakemake") is None, reason="snakemake is not installed (extra `cluster`)"
)


def emit(folder: Path, *captures: Path) -> str:
    words = [*map(str, captures), "--emit", "snakefile", "--workspaces", str(folder / "subjects")]
    done = CliRunner().invoke(
        app, ["pipeline", *words, "-o", str(folder / "Snakefile"), "--preset", "tiny", "--json"]
    )
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["result"]["jobs"] == len(captures) * len(PIPELINE)
    return (folder / "Snakefile").read_text()


def snakemake(folder: Path, *words: str, seconds: float = 120) -> subprocess.CompletedProcess[str]:
    binaries = str(Path(sys.executable).parent)
    environment = os.environ | {"PATH": f"{binaries}:{os.environ['PATH']}", "HOME": str(folder)}
    return subprocess.run(
        [sys.executable, "-m", "snakemake", "--snakefile", str(folder / "Snakefile"), *words],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=seconds, check=False,
    )  # fmt: skip


@pytest.fixture
def captures(tmp_path: Path) -> list[Path]:
    folders = [tmp_path / 'anna\'s "in" box' / name for name in ("anna", "bert-o")]
    for folder in folders:
        folder.mkdir(parents=True)
    return folders


def test_every_stage_of_the_table_is_a_rule(tmp_path: Path, captures: list[Path]) -> None:
    text = emit(tmp_path, *captures)
    rules = [line.split()[1].rstrip(":") for line in text.splitlines() if line.startswith("rule ")]
    assert rules == ["all", *(spec.name.replace("-", "_") for spec in PIPELINE)]
    for spec in PIPELINE:
        rule = text.split(f"rule {spec.name.replace('-', '_')}:")[1].split("\nrule ")[0]
        given = rule.split("output:")[0]
        assert all(f"/{read}/current.json" in given for read in spec.reads)
        assert f"/{spec.name}/current.json" in rule.split("output:")[1]
        assert "--preset {PRESET:q}" in rule
    header = text.split("rule all:")[0].split('"""')[2].replace("config.get", "dict().get")
    said: dict[str, object] = {}
    exec(compile(header, "Snakefile", "exec"), said)
    assert said["CAPTURES"] == {folder.name: str(folder) for folder in captures}
    assert said["PRESET"] == "tiny" and said["WORKSPACES"] == str(tmp_path / "subjects")


def test_what_cannot_be_a_workflow(tmp_path: Path, captures: list[Path]) -> None:
    def code(*words: object) -> int:
        return CliRunner().invoke(app, ["pipeline", *map(str, words)]).exit_code

    assert code("--emit", "snakefile") == 2
    assert code(captures[0], "--emit", "make") == 2
    assert code(captures[0], captures[0], "--emit", "snakefile") == 2
    assert code(tmp_path / "no", "--emit", "snakefile") == 66
    assert not list(tmp_path.glob("Snakefile*"))


def test_the_table_is_listed() -> None:
    done = CliRunner().invoke(app, ["pipeline", "--json"])
    listed = json.loads(done.stdout.splitlines()[-1])["result"]["stages"]
    assert [row["stage"] for row in listed] == [spec.name for spec in PIPELINE]


@needs_snakemake
def test_snakemake_plans_every_job(tmp_path: Path, captures: list[Path]) -> None:
    emit(tmp_path, *captures)
    done = snakemake(tmp_path, "--dry-run", "--cores", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    said = done.stdout + done.stderr
    for spec in PIPELINE:
        assert said.count(f"rule {spec.name.replace('-', '_')}:") == len(captures)


@needs_snakemake
@pytest.mark.long
@pytest.mark.timeout(1800)
def test_two_subjects_through_all_stages(tmp_path: Path) -> None:
    people = tmp_path / "people"
    assert CliRunner().invoke(app, ["synth", str(people), "--preset", "tiny"]).exit_code == 0
    emit(tmp_path, people / "subject_1", people / "subject_2")
    done = snakemake(tmp_path, "--cores", "2", seconds=1500)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in ("subject_1", "subject_2"):
        status = CliRunner().invoke(app, ["status", str(tmp_path / "subjects" / name), "--json"])
        states = json.loads(status.stdout.splitlines()[-1])["result"]["stages"]
        assert {row["state"] for row in states} == {"up to date"}
    again = snakemake(tmp_path, "--cores", "2")
    assert "Nothing to be done" in again.stdout + again.stderr
