"""Artifacts are whole or absent, found by what made them, and the same bytes for the same content."""

from __future__ import annotations

import dataclasses
import getpass
import shutil
import socket
import stat
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.shared.artifacts import Artifact, ExternalFiles, StageSpec, Workspace
from stages.shared.artifacts.canonical import seal, unseal
from stages.shared.errors import BadData, MissingInput
from tests.shared.artifacts.conftest import FIRST, SECOND, Config, make_first, make_second, poses


def content(artifact: Artifact) -> dict[str, bytes]:
    names = ("manifest.json", *artifact.files)
    return {name: (artifact.path / name).read_bytes() for name in names}


def hidden(workspace: Workspace) -> list[str]:
    return [path.name for path in workspace.root.glob(".*") if path.name not in (".lock", ".digests.json")]


def test_what_was_written_is_read_back(workspace: Workspace, capture: Path) -> None:
    artifact = make_first(workspace, capture)
    arrays = artifact.arrays("template.safetensors")
    np.testing.assert_array_equal(arrays["vertices"], np.arange(12, dtype=np.float32).reshape(4, 3) * 64)
    assert arrays["faces"].dtype == np.int32 and arrays["seams"].shape == (0, 2)
    assert artifact.json("report.json") == {"share_inside": 0.5, "cameras": ["a", "b"]}
    assert artifact.file("previews/film.mp4").read_bytes() == b"film" == artifact.bytes("previews/film.mp4")
    assert artifact.summary == {"vertices": 4, "sizes": [1.0, 2.5]}
    assert artifact.config == {"grid": 64, "sizes": [1.0, 2.5]}
    assert artifact.run["frames_per_second"] == 3.5 and artifact.run["libraries"]["numpy"] == np.__version__
    assert artifact.path == workspace.root / "first" / artifact.key


def test_the_manifest_says_what_the_arrays_are(workspace: Workspace, capture: Path) -> None:
    described = make_first(workspace, capture).manifest.arrays["template.safetensors"]
    assert described["vertices"] == {
        "shape": [4, 3],
        "dtype": "float32",
        "about": "m world (V,3)",
        "min": 0.0,
        "max": 704.0,
    }
    assert described["seams"]["min"] is None


def test_pictures_are_what_opencv_reads(workspace: Workspace, capture: Path) -> None:
    read = cv2.imread(str(make_first(workspace, capture).file("overlay.png")), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(read, np.arange(60, dtype=np.uint8).reshape(4, 5, 3))


def test_the_same_content_gives_the_same_bytes_at_another_time_and_place(
    tmp_path: Path, capture: Path
) -> None:
    one = make_first(Workspace(tmp_path / "one"), capture)
    time.sleep(1.1)  # run.json has seconds in its dates
    moved = tmp_path / "deeper" / "moved"
    shutil.copytree(capture, moved)
    two = make_first(Workspace(tmp_path / "elsewhere" / "two"), moved, Config(device="cuda"))
    assert one.run["started"] != two.run["started"]
    assert (one.key, one.digest, content(one)) == (two.key, two.digest, content(two))


def test_no_artifact_tells_user_host_or_place(workspace: Workspace, capture: Path) -> None:
    artifact = make_second(workspace, capture, make_first(workspace, capture))
    everything = b"".join(path.read_bytes() for path in workspace.root.glob("*/*/**/*") if path.is_file())
    assert b"label-f000001.png" in everything and artifact.key.encode() not in everything
    for secret in (str(capture), str(workspace.root), socket.gethostname(), f"/{getpass.getuser()}/"):
        assert secret.encode() not in everything
    assert workspace.settings() == {"capture": "../capture"}


def test_find_gives_the_artifact_of_the_same_question_only(workspace: Workspace, capture: Path) -> None:
    inputs = {"capture/poses": poses(capture)}
    assert workspace.find(FIRST, Config(), inputs) is None
    artifact = make_first(workspace, capture)
    found = workspace.find(FIRST, Config(device="cuda"), inputs)
    assert found is not None and found.digest == artifact.digest
    assert workspace.find(FIRST, Config(grid=32), inputs) is None
    assert workspace.find(StageSpec("first", "", (), code_version=2), Config(), inputs) is None
    (capture / "poses.npz").write_bytes(b"other")
    assert workspace.find(FIRST, Config(), inputs) is None
    (capture / "poses.npz").write_bytes(b"poses")
    assert workspace.find(FIRST, Config(), inputs) is not None


def test_find_puts_an_earlier_artifact_back_in_use(workspace: Workspace, capture: Path) -> None:
    early = make_first(workspace, capture)
    late = make_first(workspace, capture, Config(grid=32))
    assert workspace.require(FIRST).key == late.key
    assert workspace.find(FIRST, Config(), {"capture/poses": poses(capture)}) is not None
    assert workspace.require(FIRST).key == early.key


def test_what_is_missing_is_named_with_its_command(workspace: Workspace, capture: Path) -> None:
    assert workspace.current(FIRST) is None
    make_first(workspace, capture)
    with pytest.raises(MissingInput) as caught:
        workspace.require(SECOND)
    assert caught.value.fix == f"Run: gw second {workspace.root}"
    assert workspace.command(FIRST) == f"gw first {capture} -o {workspace.root}"
    with pytest.raises(MissingInput, match=r"template\.safetensors"):
        workspace.require(FIRST).arrays("another")


def test_another_major_schema_is_refused_with_both_numbers(workspace: Workspace, capture: Path) -> None:
    make_first(workspace, capture)
    assert workspace.require(dataclasses.replace(FIRST, schema="1.7")).stage == "first"
    with pytest.raises(BadData, match=r"has schema 1\.0; this gw reads 2\.0"):
        workspace.require(dataclasses.replace(FIRST, schema="2.0"))


def test_another_version_of_the_store_is_refused(workspace: Workspace, capture: Path) -> None:
    path = make_first(workspace, capture).path / "manifest.json"
    value = unseal(path.read_bytes(), path)
    path.unlink()
    path.write_bytes(seal({**value, "store": 2}))
    with pytest.raises(BadData, match="reads 1"):
        workspace.require(FIRST)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_error_inside_leaves_nothing(
    workspace: Workspace, capture: Path, error: type[BaseException]
) -> None:
    with pytest.raises(error), workspace.build(FIRST, Config(), {"capture/poses": poses(capture)}) as build:
        build.write_json("half", 1)
        raise error
    assert workspace.current(FIRST) is None and hidden(workspace) == []
    assert not hasattr(build, "artifact")
    make_first(workspace, capture)


def test_a_file_that_was_not_written_through_the_build_is_refused(
    workspace: Workspace, capture: Path
) -> None:
    with (
        pytest.raises(ValueError, match="stray"),
        workspace.build(FIRST, Config(), {"capture/poses": poses(capture)}) as build,
    ):
        (build.path / "stray.txt").write_text("?")
    assert workspace.current(FIRST) is None and hidden(workspace) == []


@pytest.mark.parametrize(
    "name", ["../out.json", "/etc/x.json", "a/../b.json", ".hidden.json", "manifest.json", "run.json"]
)
def test_names_stay_inside_the_artifact(workspace: Workspace, capture: Path, name: str) -> None:
    with (
        pytest.raises(ValueError, match="cannot be the name"),
        workspace.build(FIRST, Config(), {"capture/poses": poses(capture)}) as build,
    ):
        build.write_json(name, 1)


def test_finished_files_are_read_only_and_removable(workspace: Workspace, capture: Path) -> None:
    artifact = make_first(workspace, capture)
    for path in artifact.path.rglob("*"):
        if path.is_file():
            assert stat.S_IMODE(path.stat().st_mode) == 0o444
    shutil.rmtree(workspace.root)
    assert not workspace.root.exists()


def test_made_again_it_stays_unless_forced(workspace: Workspace, capture: Path) -> None:
    started = make_first(workspace, capture).path.stat().st_ino
    assert make_first(workspace, capture).path.stat().st_ino == started
    assert make_first(workspace, capture, force=True).path.stat().st_ino != started
    assert hidden(workspace) == []


@pytest.mark.parametrize("damage", ["shortened", "one bit"])
def test_a_damaged_artifact_is_not_found_and_is_made_anew(
    workspace: Workspace, capture: Path, damage: str
) -> None:
    artifact = make_first(workspace, capture)
    good = content(artifact)
    path = artifact.path / "template.safetensors"
    path.chmod(0o644)
    data = path.read_bytes()
    path.write_bytes(data[:-1] if damage == "shortened" else data[:-1] + bytes([data[-1] ^ 1]))
    assert workspace.find(FIRST, Config(), {"capture/poses": poses(capture)}) is None
    with pytest.raises(BadData, match=r"bytes instead of|content has changed"):
        workspace.require(FIRST).arrays("template")
    assert content(make_first(workspace, capture)) == good


def test_what_a_killed_process_left_is_removed(workspace: Workspace, capture: Path) -> None:
    make_first(workspace, capture)
    (workspace.root / ".first.tmp-0123456789ab").mkdir()
    (workspace.root / ".subject.json.tmp-0123456789ab").write_text("half")
    (workspace.root / "first" / ".current.json.tmp-0123456789ab").write_text("half")
    make_first(workspace, capture, Config(grid=1))
    assert hidden(workspace) == [] and list((workspace.root / "first").glob(".*")) == []


def test_inputs_must_be_there_and_below_their_root(
    workspace: Workspace, capture: Path, tmp_path: Path
) -> None:
    for files, error in (([capture / "no.npz"], MissingInput), ([tmp_path / "outside"], ValueError)):
        inputs = {"x": ExternalFiles("x", capture, files)}
        (tmp_path / "outside").write_text("x")
        with pytest.raises(error, match=r"not there|not below"), workspace.build(FIRST, Config(), inputs):
            raise AssertionError("the block was entered")
        assert hidden(workspace) == []


def test_a_setting_that_leads_elsewhere_is_kept(workspace: Workspace, capture: Path) -> None:
    workspace.save_settings(capture=capture / "poses.npz", capture_format="native")
    make_first(workspace, capture)
    assert workspace.settings() == {
        "capture": "../capture/poses.npz",
        "capture_format": "native",
        "capture_root": "../capture",
    }
    assert workspace.setting_path("capture") == capture / "poses.npz"
    with pytest.raises(MissingInput, match="has no scan"):
        workspace.setting_path("scan")


def test_paths_are_kept_relative_through_links(tmp_path: Path, capture: Path) -> None:
    (tmp_path / "far" / "away").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "far" / "away")
    workspace = Workspace(tmp_path / "link" / "subject")
    artifact = make_first(workspace, capture)
    assert workspace.settings() == {"capture": "../../../capture"}
    assert workspace.setting_path("capture") == capture
    assert [path.name for path in Workspace(workspace.root.resolve()).artifacts()] == [artifact.key]


def test_settings_that_are_not_json_are_refused(workspace: Workspace) -> None:
    workspace.save_settings(capture="..")
    (workspace.root / "subject.json").write_text('{"capture": ')
    with pytest.raises(BadData, match="cannot be read"):
        workspace.settings()


def test_a_published_file_is_a_copy(workspace: Workspace, capture: Path) -> None:
    artifact = make_first(workspace, capture)
    target = workspace.publish(artifact, "report.json", "report.json")
    assert target.read_bytes() == artifact.bytes("report.json")
    target.write_text("edited")
    assert workspace.publish(artifact, "report.json", "report.json").read_bytes() == artifact.bytes(
        "report.json"
    )
    with pytest.raises(ValueError, match="not a name"):
        workspace.publish(artifact, "report.json", "../report.json")
