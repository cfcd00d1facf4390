"""The Tab key: what each place offers, and that the shell gets it from the installed program."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gw_cli import completion
from stages.pipeline import BY_NAME, PIPELINE
from stages.shared.artifacts import Workspace


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    workspace = Workspace(tmp_path / "anna")
    workspace.save_settings(note="a subject")
    with workspace.build(BY_NAME["bake-maps"], {}, {}) as build:
        build.summary(layers=["lower", "body"])
    (tmp_path / "other").mkdir()
    (tmp_path / "skirt.gwg").write_bytes(b"")
    (tmp_path / "skirt.png").write_bytes(b"")
    return tmp_path


def shell(folder: Path, *words: str) -> list[str]:
    """What bash would offer for the last word."""
    environment = os.environ | {
        "_GW_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(("gw", *words)),
        "COMP_CWORD": str(len(words)),
    }
    program = "import sys; sys.argv = ['gw']; from gw_cli.app import app; app(prog_name='gw')"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    return done.stdout.split()


def test_presets_are_those_of_the_stages() -> None:
    for spec in PIPELINE:
        presets = importlib.import_module(f"stages.{spec.name.replace('-', '_')}.config").PRESETS
        assert set(presets) <= set(completion.PRESETS)
    assert completion.presets("d") == ["draft"] and len(completion.presets("")) == 4


def test_layers_of_a_subject(folder: Path) -> None:
    class Context:
        params = {"subject": folder / "anna"}  # noqa: RUF012
        args: list[str] = []  # noqa: RUF012

    assert completion.layers(Context, "") == ["body", "lower"]
    assert completion.layers(None, "o") == ["outer"]


def test_trainings_of_a_subject(folder: Path) -> None:
    workspace = Workspace(folder / "anna")
    keys = []
    for steps in (1, 2):
        with workspace.build(BY_NAME["train"], {"steps": steps}, {}) as build:
            build.summary(steps=steps)
        keys.append(build.artifact.key)

    class Context:
        params = {"subject": folder / "anna"}  # noqa: RUF012

    assert completion.trainings(Context, "") == sorted(keys)
    assert completion.trainings(Context, keys[1][:8]) == [keys[1]]
    assert completion.trainings(None, "") == []


def test_subjects_and_bundles(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert completion.subjects("") == ["anna"]
    assert completion.bundles("") == ["skirt.gwg", "anna/", "other/"]
    assert completion.artifacts("sk") == ["skirt.gwg"]
    assert completion.subjects(f"{folder}/a") == [f"{folder}/anna"]
    assert completion.subjects("no/where/") == []


def test_bash_is_offered_them(folder: Path) -> None:
    assert shell(folder, "train", "anna", "--preset", "b") == ["balanced"]
    assert shell(folder, "export-garment", "anna", "--layer", "") == ["body", "lower"]
    assert shell(folder, "segment-layers", "an") == ["anna"]
    assert "train" in shell(folder, "tr")
    for words in (("inspect",), ("tryon",), ("render",), ("view",), ("wardrobe", "add", "closet")):
        assert shell(folder, *words, "sk") == ["skirt.gwg"]
    assert shell(folder, "evaluate", "an") == ["anna"]
