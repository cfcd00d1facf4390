"""Exactly the stages downstream of a change are stale, and each says why."""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from stages.shared.artifacts import Artifact, ExternalFiles, StageSpec, Workspace, external
from stages.shared.artifacts.external import DigestCache
from stages.shared.artifacts.staleness import StageState, next_stage, staleness
from tests.shared.artifacts.conftest import Config, labels, poses

REGISTER_TEMPLATE = StageSpec("register-template", "gw register-template CAPTURE -o SUBJECT", ())
CANONICALIZE = StageSpec("canonicalize", "gw canonicalize SUBJECT", ("register-template",))
SEGMENT_LAYERS = StageSpec(
    "segment-layers", "gw segment-layers SUBJECT", ("register-template", "canonicalize")
)
BAKE_MAPS = StageSpec("bake-maps", "gw bake-maps SUBJECT", ("canonicalize", "segment-layers"))
TRAIN = StageSpec("train", "gw train SUBJECT", ("register-template", "bake-maps"))
PIPELINE = (REGISTER_TEMPLATE, CANONICALIZE, SEGMENT_LAYERS, BAKE_MAPS, TRAIN)
BY_NAME = {spec.name: spec for spec in PIPELINE}


def make(workspace: Workspace, spec: StageSpec, capture: Path, config: Config = Config()) -> Artifact:
    inputs: dict[str, Artifact | ExternalFiles] = {
        name: workspace.require(BY_NAME[name]) for name in spec.reads
    }
    if spec is REGISTER_TEMPLATE:
        inputs["capture/poses"] = poses(capture)
    if spec is SEGMENT_LAYERS:
        inputs["capture/labels"] = labels(capture)
    found = workspace.find(spec, config, inputs)
    if found is not None:
        return found
    with workspace.build(spec, config, inputs) as build:
        build.write_arrays("numbers", {"grid": np.array([config.grid])})
    return build.artifact


@pytest.fixture
def finished(workspace: Workspace, capture: Path) -> Workspace:
    for spec in PIPELINE:
        make(workspace, spec, capture)
    return workspace


def states(workspace: Workspace) -> dict[str, StageState]:
    return {state.stage: state for state in staleness(workspace, PIPELINE)}


def not_up_to_date(workspace: Workspace) -> dict[str, list[str]]:
    return {name: state.reasons for name, state in states(workspace).items() if state.state != "up to date"}


def test_a_finished_subject_is_up_to_date(finished: Workspace) -> None:
    assert not_up_to_date(finished) == {}
    assert next_stage(staleness(finished, PIPELINE), PIPELINE) is None


def test_a_new_subject_says_what_to_run(workspace: Workspace, capture: Path) -> None:
    assert {state.state for state in states(workspace).values()} == {"not made"}
    make(workspace, REGISTER_TEMPLATE, capture)
    found = staleness(workspace, PIPELINE)
    assert [state.state for state in found] == ["up to date", *["not made"] * 4]
    following = next_stage(found, PIPELINE)
    assert following is CANONICALIZE
    assert found[1].reasons == [f"run: gw canonicalize {workspace.root}"]


def test_a_changed_label_image_names_itself_and_all_downstream(finished: Workspace, capture: Path) -> None:
    (capture / "labels" / "Cam001" / "label-f000000.png").write_bytes(b"other")
    assert not_up_to_date(finished) == {
        "segment-layers": ["capture/labels: labels/Cam001/label-f000000.png changed"],
        "bake-maps": ["segment-layers is stale"],
        "train": ["bake-maps is stale"],
    }


def test_a_change_that_keeps_size_and_time_is_seen(
    finished: Workspace, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(external, "_SETTLED_NANOSECONDS", 0)
    assert not_up_to_date(finished) == {}
    path = capture / "poses.npz"
    before = path.stat()
    path.write_bytes(b"posed")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert set(not_up_to_date(finished)) == {spec.name for spec in PIPELINE}


def test_touching_without_changing_makes_nothing_stale(finished: Workspace, capture: Path) -> None:
    for path in capture.rglob("*"):
        os.utime(path)
    assert not_up_to_date(finished) == {}


def test_a_missing_file_is_named(finished: Workspace, capture: Path) -> None:
    (capture / "poses.npz").unlink()
    assert not_up_to_date(finished)["register-template"] == ["capture/poses: poses.npz is gone"]
    assert set(not_up_to_date(finished)) == {spec.name for spec in PIPELINE}


def test_many_changed_files_are_counted(
    finished: Workspace, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in capture.glob("labels/*/*.png"):
        path.write_bytes(b"other")
    monkeypatch.setattr("stages.shared.artifacts.staleness._SHOWN_FILES", 1)
    assert not_up_to_date(finished)["segment-layers"] == [
        "capture/labels: labels/Cam001/label-f000000.png changed",
        "capture/labels: 3 more of 4 files",
    ]


def test_a_moved_capture_is_found_by_its_setting(finished: Workspace, capture: Path, tmp_path: Path) -> None:
    shutil.move(capture, tmp_path / "moved")
    reasons = not_up_to_date(finished)
    assert reasons["register-template"] == [
        "capture/poses: capture is not where subject.json says (../capture)"
    ]
    finished.save_settings(capture=tmp_path / "moved")
    assert not_up_to_date(finished) == {}


def test_subject_and_capture_moved_together_are_up_to_date(
    finished: Workspace, capture: Path, tmp_path: Path
) -> None:
    (tmp_path / "new").mkdir()
    shutil.move(capture, tmp_path / "new" / "capture")
    shutil.move(finished.root, tmp_path / "new" / "subject")
    assert not_up_to_date(Workspace(tmp_path / "new" / "subject")) == {}


def test_an_upstream_made_again_says_what_differs(finished: Workspace, capture: Path) -> None:
    make(finished, CANONICALIZE, capture, Config(grid=128))
    assert not_up_to_date(finished) == {
        "segment-layers": ["canonicalize was made again (config: grid 64 -> 128)"],
        "bake-maps": ["canonicalize was made again (config: grid 64 -> 128)", "segment-layers is stale"],
        "train": ["bake-maps is stale"],
    }
    make(finished, CANONICALIZE, capture)
    assert not_up_to_date(finished) == {}


def test_running_the_stale_stages_brings_all_up_to_date(finished: Workspace, capture: Path) -> None:
    (capture / "poses.npz").write_bytes(b"other")
    for left in range(len(PIPELINE), 0, -1):
        found = staleness(finished, PIPELINE)
        assert sum(state.state != "up to date" for state in found) == left
        following = next_stage(found, PIPELINE)
        assert following is PIPELINE[-left]
        make(finished, following, capture)
    assert not_up_to_date(finished) == {}


def test_newer_code_and_another_configuration_are_reasons(finished: Workspace) -> None:
    newer = [dataclasses.replace(spec, code_version=2) if spec is BAKE_MAPS else spec for spec in PIPELINE]
    found = {state.stage: state.reasons for state in staleness(finished, newer) if state.state == "stale"}
    assert found == {"bake-maps": ["code version 1 -> 2"], "train": ["bake-maps is stale"]}
    found = {
        s.stage: s.reasons for s in staleness(finished, PIPELINE, {"train": Config(grid=8)}) if s.reasons
    }
    assert found == {"train": ["config: grid 64 -> 8"]}


@pytest.mark.parametrize("damage", ["flip", "remove", "manifest", "pointer"])
def test_a_damaged_artifact_is_damaged_and_its_readers_stale(finished: Workspace, damage: str) -> None:
    artifact = finished.require(SEGMENT_LAYERS)
    path = {
        "flip": artifact.path / "numbers.safetensors",
        "remove": artifact.path / "numbers.safetensors",
        "manifest": artifact.path / "manifest.json",
        "pointer": artifact.path.parent / "current.json",
    }[damage]
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.unlink()
    if damage != "remove":
        path.write_bytes(data)
    found = states(finished)
    assert [state.state for state in found.values()] == [
        "up to date",
        "up to date",
        "damaged",
        "stale",
        "stale",
    ]
    assert path.name in found["segment-layers"].reasons[0]
    assert found["bake-maps"].reasons == ["segment-layers is damaged"]


def test_unchanged_files_are_not_read_twice(finished: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []
    original = external.file_digest
    monkeypatch.setattr(external, "_SETTLED_NANOSECONDS", 0)

    def counted(path: Path) -> str:
        read.append(path)
        return original(path)

    monkeypatch.setattr(external, "file_digest", counted)
    assert not_up_to_date(finished) == {} and len(read) > 5
    read.clear()
    assert not_up_to_date(finished) == {} and read == []


def test_files_changed_a_moment_ago_are_not_remembered(workspace: Workspace, capture: Path) -> None:
    workspace.root.mkdir()
    cache = DigestCache(workspace.root)
    first = cache.digest(capture / "poses.npz")
    (capture / "poses.npz").write_bytes(b"posed")
    assert cache.digest(capture / "poses.npz") != first


@pytest.mark.parametrize("text", ["", "[]", '{"a": [1]}', "\x00"])
def test_a_broken_cache_is_no_hindrance(finished: Workspace, text: str) -> None:
    (finished.root / external.CACHE_NAME).write_text(text)
    assert not_up_to_date(finished) == {}
