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

from stages.doctor.libraries import OPTIONAL
from stages.shared.meshes.raycast import SYSTEM_LIBRARIES

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


def container() -> list[tuple[str, str]]:
    """Instructions of the container file, continued lines joined: name and the rest."""
    text = (REPOSITORY / "Containerfile").read_text().replace("\\\n", " ")
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(name, " ".join(rest.split())) for name, _, rest in (line.partition(" ") for line in lines)]


def test_the_container_has_no_root_and_no_open_end() -> None:
    told = container()
    assert [rest for name, rest in told if name == "USER"] == ["1000"]
    (install,) = [rest for name, rest in told if name == "RUN" and "pip install" in rest]
    assert "-c /tmp/constraints.txt" in install, "the lock holds in the container too"
    order = [name for name, _ in told]
    assert order.index("USER") > max(index for index, name in enumerate(order) if name == "RUN")
    (base,) = [rest for name, rest in told if name == "FROM"]
    version = re.fullmatch(r"python:(\d+)\.(\d+)-slim", base)
    assert version and int(version[1]) == 3
    assert f">=3.{min(11, int(version[2]))}" == PROJECT["project"]["requires-python"]
    assert any(f"Python :: 3.{version[2]}" in row for row in PROJECT["project"]["classifiers"])


def test_the_container_copies_what_there_is_and_starts_what_is_installed() -> None:
    """Every file that is copied is there (or made by the build) and let through to the daemon."""
    let_through = [
        line[1:]
        for line in (REPOSITORY / ".containerignore").read_text().splitlines()
        if line.startswith("!")
    ]
    for source in (rest.split()[0] for name, rest in container() if name == "COPY"):
        assert source in let_through
        assert source == "dist/*.whl" or (REPOSITORY / source).is_file()
    (start,) = [json.loads(rest) for name, rest in container() if name == "ENTRYPOINT"]
    assert start[0] in PROJECT["project"]["scripts"]
    (packages,) = [rest for name, rest in container() if name == "RUN" and "apt-get install" in rest]
    assert set(SYSTEM_LIBRARIES.values()) <= set(packages.split()), "what open3d links against"
    (words,) = [json.loads(rest) for name, rest in container() if name == "CMD"]
    done = subprocess.run(
        [sys.executable, "-m", "gw_cli", *words], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and "register-template" in done.stdout


def test_the_metadata_is_whole() -> None:
    project = PROJECT["project"]
    assert project["license"] == "Apache-2.0" and (REPOSITORY / project["license-files"][0]).is_file()
    assert project["dynamic"] == ["version"], "the version is the tag"
    assert {"description", "readme", "keywords", "classifiers"} <= set(project)
    for package in ("gw_cli", "stages"):
        assert (REPOSITORY / package / "py.typed").is_file()
    extras = set(project["optional-dependencies"])
    optional = {
        re.split(r"[<>=;\[ ]", row)[0]
        for name, rows in project["optional-dependencies"].items()
        for row in rows
        if name != "dev"
    }
    assert optional == set(OPTIONAL), "gw doctor looks for what the extras bring"
    said = (REPOSITORY / "docs/dependencies.md").read_text()
    assert all(f"`{extra}`" in said for extra in extras), "every extra says what it is for"


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
    (about,) = [name for name in inside if name.endswith("/METADATA")]
    metadata = zipfile.ZipFile(wheel).read(about).decode()
    for row in ("License-Expression: Apache-2.0", "Classifier: Typing :: Typed", "Requires-Python: >=3.11"):
        assert f"\n{row}\n" in metadata
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
