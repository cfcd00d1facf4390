"""Same input, same bytes: every stage but train, run twice, with one thread and with two."""

from __future__ import annotations

from pathlib import Path

import pytest

from stages.pipeline import PIPELINE
from stages.shared.artifacts import Workspace
from tests.pipeline.chain import TINY, gw, make_chain

pytestmark = pytest.mark.timeout(900)  # the first of these makes the chain


def digests(folder: Path) -> dict[str, str]:
    workspace = Workspace(folder / "subject")
    return {spec.name: workspace.require(spec).digest for spec in PIPELINE}


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_one_and_two_threads(made: Path, tmp_path: Path) -> None:
    for threads in ("1", "2"):
        folder = tmp_path / threads
        folder.mkdir()
        make_chain(folder, OMP_NUM_THREADS=threads, NUMBA_NUM_THREADS=threads, MKL_NUM_THREADS=threads)
    one, two = digests(tmp_path / "1"), digests(tmp_path / "2")
    differing = {name for name in one if one[name] != two[name]}
    assert differing <= {"train"}
    assert files(tmp_path / "1" / "people") == files(tmp_path / "2" / "people")


def test_the_geometry_again(made: Path, tmp_path: Path) -> None:
    """The stages before training, made anew beside the first ones, on the same number of threads."""
    (tmp_path / "people").symlink_to(made / "people")
    gw("register-template", "people/subject_1", "-o", "subject", *TINY, folder=tmp_path)
    gw("canonicalize", "subject", *TINY, folder=tmp_path)
    again, first = Workspace(tmp_path / "subject"), Workspace(made / "subject")
    for spec in PIPELINE[:2]:
        assert again.require(spec).digest == first.require(spec).digest
