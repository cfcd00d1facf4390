"""What gw is built on: files locked by their hashes, free licences, and one package that is kept apart."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

REPOSITORY = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())

# Licences that let a user do what Apache-2.0 lets them do with gw; MPL asks for changes to its own files.
FREE = re.compile(
    r"\b(MIT|BSD|0BSD|Apache|ISC|PSF|MPL|Mozilla Public License|Zlib|CC0|BSL-1\.0|Unlicense)\b", re.IGNORECASE
)
# GPL-3 and therefore never in gw's own process: it runs as a child, and there is a fallback without it.
APART = {"pymeshlab"}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(text: str) -> dict[str, str]:
    """Canonical name to version, without what tells builds apart ("2.13.0+cpu")."""
    rows = re.findall(r"^([\w.-]+)==([^\s+;]+)", text, re.MULTILINE)
    return {canonical(name): version for name, version in rows}


def test_every_file_of_the_lock_has_a_hash() -> None:
    constraints = (REPOSITORY / "constraints.txt").read_text()
    lock = (REPOSITORY / "requirements.lock").read_text()
    assert pins(lock) == pins(constraints), "make it again: tests/release/make_lock.py"
    rows = [line for line in lock.splitlines() if not line.startswith("#")]
    assert len(rows) == len(pins(lock)) > 100
    assert all(re.fullmatch(r"\S+==\S+ --hash=sha256:[0-9a-f]{64}", row) for row in rows)


def core() -> dict[str, metadata.Distribution]:
    """What `pip install gaussian-wardrobe` brings, with all that it needs in turn."""
    found: dict[str, metadata.Distribution] = {}
    waiting = [(text, frozenset({""})) for text in PROJECT["project"]["dependencies"]]
    while waiting:
        text, extras = waiting.pop()
        wanted = Requirement(text)
        if wanted.marker and not any(wanted.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        if canonical(wanted.name) not in found:
            distribution = metadata.distribution(wanted.name)
            found[canonical(wanted.name)] = distribution
            inner = frozenset(wanted.extras) | {""}
            waiting += [(row, inner) for row in distribution.requires or ()]
    return found


def licence(distribution: metadata.Distribution) -> str:
    """The expression, else the classifiers, else the first line of the free text."""
    about = distribution.metadata
    classifiers = [
        row.rpartition("::")[2] for row in about.get_all("Classifier") or () if "License ::" in row
    ]
    texts = (about.get("License-Expression"), "; ".join(classifiers), about.get("License"))
    return next((text for text in texts if text), "").strip().split("\n")[0]


def test_licences_of_the_core_are_free() -> None:
    found = core()
    assert len(found) > 40 and {"torch", "open3d", "trimesh"} <= set(found)
    strange = {name: licence(d) for name, d in found.items() if not FREE.search(licence(d))}
    assert set(strange) == APART, strange


@pytest.mark.parametrize("name", sorted(APART))
def test_what_is_apart_is_never_imported_here(name: str) -> None:
    """The one module that imports it is run as a program of its own."""
    importers = [
        path.relative_to(REPOSITORY).as_posix()
        for package in ("gw_cli", "stages")
        for path in (REPOSITORY / package).rglob("*.py")
        if re.search(rf"^\s*(import|from) {name}\b", path.read_text(), re.MULTILINE)
    ]
    assert importers == ["stages/shared/meshes/remesh.py"]
