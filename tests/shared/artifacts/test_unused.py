"""Artifacts that nothing uses: found, removed, and never one that something needs."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.artifacts import Artifact, StageSpec, Workspace
from stages.shared.artifacts.unused import remove_unused, unused
from stages.shared.artifacts.verify import verify
from stages.shared.errors import BadData, Locked, MissingInput

FIRST = StageSpec("first", "gw first", ())
SECOND = StageSpec("second", "gw second", ("first",))


def make(workspace: Workspace, spec: StageSpec, number: int, **inputs: Artifact) -> Artifact:
    with workspace.build(spec, {"number": number}, inputs) as build:
        build.write_arrays("x", {"x": np.full(100, number)})
    return build.artifact


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    """first: 1, 2 (in use). second: made from 1 (in use), and an older one made from 2."""
    workspace = Workspace(tmp_path / "subject")
    one = make(workspace, FIRST, 1)
    two = make(workspace, FIRST, 2)
    make(workspace, FIRST, 3)
    make(workspace, SECOND, 1, first=two)
    make(workspace, SECOND, 2, first=one)
    return workspace


def test_what_is_in_use_and_what_it_came_from_stays(workspace: Workspace) -> None:
    found = {artifact.path.parent.name: artifact for artifact in unused(workspace)}
    assert set(found) == {"first", "second"} and len(unused(workspace)) == 2
    assert found["first"].bytes > 800
    assert remove_unused(workspace) == list(found.values())
    assert not any(artifact.path.exists() for artifact in found.values())
    assert len(workspace.artifacts()) == 3 and verify(workspace).damaged == []
    assert unused(workspace) == [] and not list(workspace.root.glob(".*tmp*"))


def test_the_command(workspace: Workspace) -> None:
    subject = str(workspace.root)
    assert CliRunner().invoke(app, ["clean", subject]).exit_code == 2
    done = CliRunner().invoke(app, ["clean", subject, "--unused", "--dry-run", "--json"])
    found = json.loads(done.stdout.splitlines()[-1])["result"]
    assert found["dry_run"] and len(found["artifacts"]) == 2 and len(workspace.artifacts()) == 5
    assert CliRunner().invoke(app, ["clean", subject, "--unused"]).exit_code == 0
    assert len(workspace.artifacts()) == 3
    assert CliRunner().invoke(app, ["clean", subject + "x", "--unused"]).exit_code == 66


def test_a_busy_workspace_is_left_alone(workspace: Workspace) -> None:
    errors: list[Exception] = []

    def other() -> None:
        try:
            remove_unused(workspace)
        except Locked as error:
            errors.append(error)

    with workspace.writing():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(errors) == 1 and len(workspace.artifacts()) == 5


def test_a_damaged_pointer_stops_it(workspace: Workspace) -> None:
    (workspace.root / "second" / "current.json").write_text("{}")
    with pytest.raises(BadData):
        remove_unused(workspace)
    assert len(workspace.artifacts()) == 5
    with pytest.raises(MissingInput):
        unused(Workspace(workspace.root / "no"))
