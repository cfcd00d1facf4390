"""`gw status` and `gw verify` as a user sees them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.pipeline import BY_NAME, PIPELINE
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace


def gw(*words: str | Path) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.stdout, done.stderr


def result(stdout: str) -> dict[str, Any]:
    (found,) = (row["result"] for row in map(json.loads, stdout.splitlines()) if "result" in row)
    assert isinstance(found, dict)
    return found


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    folder = tmp_path / "capture"
    folder.mkdir()
    (folder / "poses.npz").write_bytes(b"poses")
    (folder / "label.png").write_bytes(b"label")
    return folder


@pytest.fixture
def subject(tmp_path: Path, capture: Path) -> Path:
    """All stages of the real table, each with one small array."""
    workspace = Workspace(tmp_path / "subject")
    for spec in PIPELINE:
        inputs: dict[str, Artifact | ExternalFiles] = {
            name: workspace.require(BY_NAME[name]) for name in spec.reads
        }
        if spec.name == "register-template":
            inputs["capture/poses"] = ExternalFiles("capture/poses", capture, [capture / "poses.npz"])
        if spec.name == "segment-layers":
            inputs["capture/labels"] = ExternalFiles("capture/labels", capture, [capture / "label.png"])
        with workspace.build(spec, {"grid": 3}, inputs) as build:
            build.write_arrays("numbers", {"x": np.arange(3)})
    return workspace.root


def test_all_up_to_date(subject: Path) -> None:
    code, stdout, stderr = gw("status", subject)
    assert code == 0 and stdout == ""
    rows = [line.split() for line in stderr.splitlines()]
    assert [row[:4] for row in rows] == [[spec.name, "up", "to", "date"] for spec in PIPELINE]
    code, stdout, _ = gw("status", subject, "--json")
    assert code == 0 and result(stdout)["next"] is None
    assert [(row["stage"], row["state"], row["reasons"]) for row in result(stdout)["stages"]] == [
        (spec.name, "up to date", []) for spec in PIPELINE
    ]


def test_a_touched_input_shows_its_name_the_reasons_and_the_next_command(
    subject: Path, capture: Path
) -> None:
    (capture / "label.png").write_bytes(b"other")
    code, _, stderr = gw("status", subject)
    assert code == 0
    assert "capture/labels: label.png changed" in stderr and "segment-layers is stale" in stderr
    assert stderr.splitlines()[-1] == f"next: gw segment-layers {subject}"
    _, stdout, _ = gw("status", subject, "--json")
    found = result(stdout)
    assert found["next"] == f"gw segment-layers {subject}"
    expected = {"segment-layers"}
    for spec in PIPELINE:  # everything downstream, and nothing else
        if expected & set(spec.reads):
            expected.add(spec.name)
    assert {row["stage"] for row in found["stages"] if row["state"] == "stale"} == expected


def test_new_files_beside_the_inputs_are_seen(tmp_path: Path) -> None:
    """Where a stage read everything there was, a new file or a new camera is news; elsewhere it is not."""
    capture = tmp_path / "capture"
    for camera in ("cam0", "cam1"):
        for name in ("0.jpg", "1.jpg"):
            (capture / camera).mkdir(parents=True, exist_ok=True)
            (capture / camera / name).write_bytes(f"{camera}{name}".encode())
    for name in ("a.png", "b.png", "c.png"):
        (capture / name).write_bytes(name.encode())
    read = [*sorted(capture.glob("cam*/*.jpg")), capture / "a.png", capture / "b.png"]
    workspace = Workspace(tmp_path / "subject")
    spec = BY_NAME["register-template"]
    with workspace.build(spec, {}, {"capture/all": ExternalFiles("capture/all", capture, read)}) as build:
        build.write_arrays("numbers", {"x": np.arange(3)})

    def reasons() -> list[str]:
        _, stdout, _ = gw("status", workspace.root, "--json")
        found = result(stdout)["stages"][0]
        assert found["state"] == ("stale" if found["reasons"] else "up to date")
        return list(found["reasons"])

    assert reasons() == []
    (capture / "d.png").write_bytes(b"one of the pictures that were not all read")
    (capture / "cam0" / "notes.txt").write_bytes(b"of another kind")
    assert reasons() == []
    (capture / "cam0" / "2.jpg").write_bytes(b"new frame")
    assert reasons() == ["capture/all: cam0/2.jpg is new"]
    (capture / "cam2").mkdir()
    assert reasons() == ["capture/all: cam2 is new", "capture/all: cam0/2.jpg is new"]


def test_a_preset_is_compared_on_request(subject: Path) -> None:
    code, stdout, _ = gw("status", subject, "--preset", "tiny", "--json")
    assert code == 0
    rows = {row["stage"]: row for row in result(stdout)["stages"]}
    assert rows["canonicalize"]["state"] == "stale"
    assert any(reason.startswith("config: grid 3 -> ") for reason in rows["canonicalize"]["reasons"])
    code, _, stderr = gw("status", subject, "--preset", "none")
    assert code == 2 and "There is no preset called 'none'" in stderr


def test_a_subject_that_is_not_there(tmp_path: Path) -> None:
    code, _, stderr = gw("status", tmp_path / "no")
    assert code == 66
    assert [line.split(":")[0].strip() for line in stderr.splitlines()] == ["error", "where", "fix"]


def test_looking_changes_nothing(subject: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in subject.rglob("*") if path.name != ".digests.json"}
    gw("status", subject)
    gw("verify", subject)
    after = {path: path.stat().st_mtime_ns for path in subject.rglob("*") if path.name != ".digests.json"}
    before.pop(subject, None), after.pop(subject, None)
    assert before == after


def test_verify_counts_what_it_read(subject: Path) -> None:
    code, stdout, _ = gw("verify", subject, "--json")
    found = result(stdout)
    assert code == 0 and found["damaged"] == [] and found["artifacts"] == len(PIPELINE) and found["bytes"] > 0
    code, _, stderr = gw("verify", subject)
    assert code == 0 and f"artifacts: {len(PIPELINE)}" in stderr


def test_verify_names_the_damaged_file(subject: Path) -> None:
    path = Workspace(subject).require(BY_NAME["bake-maps"]).path / "numbers.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 4
    path.chmod(0o644)
    path.write_bytes(data)
    code, stdout, stderr = gw("verify", subject, "--json")
    assert code == 65 and str(path) in stderr
    assert [row["path"] for row in result(stdout)["damaged"]] == [str(path)]
    _, stdout, _ = gw("status", subject, "--json")
    assert {row["stage"]: row["state"] for row in result(stdout)["stages"]}["bake-maps"] == "damaged"


def test_verify_of_something_else(tmp_path: Path, subject: Path) -> None:
    assert gw("verify", tmp_path / "no")[0] == 66
    shutil.rmtree(subject)
    assert gw("verify", tmp_path)[0] == 66


def test_verify_of_a_bundle_that_is_none(tmp_path: Path) -> None:
    assert gw("verify", tmp_path / "no.gwg")[0] == 66
    (tmp_path / "skirt.gwg").write_bytes(b"not a bundle")
    code, _, stderr = gw("verify", tmp_path / "skirt.gwg")
    assert code == 65 and "skirt.gwg" in stderr


def test_what_each_stage_took_is_shown(subject: Path) -> None:
    rows = result(gw("status", subject, "--json")[1])["stages"]
    assert len(rows) == len(PIPELINE)
    for row in rows:
        assert row["seconds"] >= 0 and row["peak_bytes"] > 10e6
    shown = gw("status", subject)[2]
    assert shown.count(" GB") == len(PIPELINE) and "took" in shown


def test_a_damaged_run_record_costs_nothing_but_the_figures(subject: Path) -> None:
    record = Workspace(subject).require(PIPELINE[1]).path / "run.json"
    record.chmod(0o644)
    record.write_text("{}")
    code, stdout, stderr = gw("status", subject, "--json")
    assert code == 0, stderr
    row = result(stdout)["stages"][1]
    assert row["seconds"] is None and row["peak_bytes"] is None
