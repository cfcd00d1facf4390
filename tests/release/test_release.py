"""What goes into a release: package data, a version, a changelog, and a wheel that works elsewhere."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())


def run(*command: str | Path, folder: Path, seconds: float = 1200) -> subprocess.CompletedProcess[str]:
    """A command in a folder outside the repository, with nothing of it on its path."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(word) for word in command], cwd=folder, env=environment,
        capture_output=True, text=True, timeout=seconds, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}: {done.stdout[-2000:]} {done.stderr[-3000:]}"
    return done


def data_files() -> list[str]:
    """Files in the packages that are not Python: without them an installed gw would lack something."""
    listed = subprocess.run(
        ["git", "ls-files", "stages", "gw_cli"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    return [name for name in listed.stdout.split("\n") if name and not name.endswith(".py")]


def test_every_data_file_is_declared() -> None:
    declared = PROJECT["tool"]["setuptools"]["package-data"]
    for name in data_files():
        fitting = [
            Path(name).match(f"{package.replace('.', '/')}/{pattern}")
            for package, patterns in declared.items()
            for pattern in patterns
        ]
        assert any(fitting), f"{name} would not be in the wheel"


def test_every_dependency_is_pinned() -> None:
    lock = (REPOSITORY / "constraints.txt").read_text()
    pinned = {
        re.sub(r"[-_.]+", "-", line.split("==")[0]).lower() for line in lock.splitlines() if "==" in line
    }
    groups = [PROJECT["project"]["dependencies"]]
    groups += [rows for name, rows in PROJECT["project"]["optional-dependencies"].items() if name != "cuda"]
    for requirement in (row for rows in groups for row in rows):
        name = re.split(r"[<>=;\[ ]", requirement)[0]
        assert re.sub(r"[-_.]+", "-", name).lower() in pinned, requirement


def test_the_changelog_speaks_of_what_comes() -> None:
    text = (REPOSITORY / "CHANGELOG.md").read_text()
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert headings[0] == "Unreleased" and all(
        re.fullmatch(r"\d+\.\d+\.\d+.*", name) for name in headings[1:]
    )


def test_the_container_has_no_root_and_no_open_end() -> None:
    lines = (REPOSITORY / "Containerfile").read_text().splitlines()
    users = [line.split()[1] for line in lines if line.startswith("USER ")]
    assert users == ["gw"]
    assert any("-c /tmp/constraints.txt" in line for line in lines), "the lock holds in the container too"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Source archive and, out of it, the wheel."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, REPOSITORY, folder=folder)
    return folder


@pytest.fixture(scope="module")
def installed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of programs of an environment that holds the wheel and its locked dependencies only."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", folder, folder=folder)
    pip = (folder / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    (wheel,) = built.glob("*.whl")
    run(*pip, "-c", REPOSITORY / "constraints.txt", wheel, folder=folder, seconds=1800)
    return folder / "bin"


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_the_archives_hold_what_they_should(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    inside = set(zipfile.ZipFile(wheel).namelist())
    assert set(data_files()) <= inside
    assert not [name for name in inside if name.startswith(("tests/", "docs/", "build/"))]
    (source,) = built.glob("*.tar.gz")
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "LICENSE", "README.md", "CHANGELOG.md", "constraints.txt"} <= names


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_the_wheel_works_from_outside(installed: Path, tmp_path: Path) -> None:
    gw = installed / "gw"
    assert "register-template" in run(gw, "--help", folder=tmp_path).stdout
    version = run(gw, "--version", folder=tmp_path).stdout.strip()
    assert re.match(r"\d+\.\d+", version)
    found = json.loads(run(gw, "doctor", "--json", folder=tmp_path).stdout.splitlines()[-1])["result"]
    assert found["version"] == version and found["broken"] == []
    where = run(installed / "python", "-c", "import stages; print(stages.__file__)", folder=tmp_path).stdout
    assert str(installed.parent) in where
    tiny = ("--preset", "tiny")
    run(gw, "synth", "people", *tiny, folder=tmp_path)
    run(gw, "register-template", "people/subject_1", "-o", "anna", *tiny, folder=tmp_path)
    for stage in ("canonicalize", "segment-layers", "bake-maps", "train"):
        run(gw, stage, "anna", *tiny, folder=tmp_path)
    for layer in ("body", "lower"):
        run(gw, "export-garment", "anna", "--layer", layer, "-o", f"{layer}.gwg", folder=tmp_path)
    run(
        gw,
        "tryon",
        "body.gwg",
        "lower.gwg",
        "--poses",
        "people/motions/held_out.npz",
        *tiny,
        "-o",
        "worn",
        folder=tmp_path,
    )
    assert list((tmp_path / "worn").rglob("*.png"))
    assert (
        json.loads(run(gw, "verify", "anna", "--json", folder=tmp_path).stdout.splitlines()[-1])["result"][
            "damaged"
        ]
        == []
    )
