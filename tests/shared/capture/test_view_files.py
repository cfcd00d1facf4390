"""Files of a camera by frame, without a path object for each, against plain dictionaries of paths."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stages.shared.capture.view_files import CameraViews, MissingList, TakeViews, numbered_files
from stages.shared.errors import BadData
from tests.benchmarks.large_capture import large_capture

_PNG = re.compile(r"(\d+)\.png")


def folder_of(root: Path, name: str, frames: list[int]) -> Path:
    (root / name).mkdir()
    for frame in frames:
        (root / name / f"{frame:04d}.png").touch()
    (root / name / "notes.txt").touch()
    return root / name


def views_of(root: Path, missing: MissingList | None = None) -> CameraViews:
    return CameraViews(*(numbered_files(root / name, _PNG) for name in ("rgb", "masks", "labels")), missing)


def test_views_are_the_frames_with_image_and_mask(tmp_path: Path) -> None:
    for name, frames in {"rgb": [4, 1, 7, 9], "masks": [1, 4, 9, 12], "labels": [9, 20]}.items():
        folder_of(tmp_path, name, frames)
    views = views_of(tmp_path)
    plain = {
        frame: tuple(tmp_path / name / f"{frame:04d}.png" for name in ("rgb", "masks")) for frame in (1, 4, 9)
    }
    assert {frame: (view.image, view.mask) for frame, view in views.items()} == plain
    assert list(views) == sorted(plain) and len(views) == 3 and 7 not in views and views.labelled
    assert views[9].labels == tmp_path / "labels" / "0009.png" and views[1].labels is None
    with pytest.raises(KeyError):
        views[7]  # it has an image, but no mask
    take = TakeViews({"a": views, "b": CameraViews(*[numbered_files(tmp_path / "none", _PNG)] * 3)})
    assert list(take) == [("a", 1), ("a", 4), ("a", 9)] and len(take) == 3
    assert ("a", 4) in take and ("b", 4) not in take and ("c", 4) not in take
    moved = numbered_files(tmp_path / "rgb", _PNG).renumbered({9: 0, 4: 1})
    assert dict(moved) == {0: tmp_path / "rgb/0009.png", 1: tmp_path / "rgb/0004.png"}


def test_listed_views_are_left_out_and_entries_without_a_view_are_named(tmp_path: Path) -> None:
    for name in ("rgb", "masks", "labels"):
        folder_of(tmp_path, name, [1, 2, 3, 4])
    entries = ["rgb/0001.png", "masks/0001.png", "./masks/../masks/0003.png", "rgb\\0004.png", "rgb/0099.png"]
    (tmp_path / "missing_img_files.txt").write_text("\ufeff" + "\n".join(["# a remark", "", *entries]))
    missing = MissingList.read(tmp_path)
    assert list(views_of(tmp_path, missing)) == [2]
    (note,) = missing.notes()
    assert note.startswith("1 of 5 entries") and "0099.png" in note
    assert MissingList.read(tmp_path / "rgb").notes() == []


def test_two_files_of_one_frame_are_refused(tmp_path: Path) -> None:
    folder_of(tmp_path, "rgb", [1, 2])
    (tmp_path / "rgb" / "2.png").touch()
    with pytest.raises(BadData, match="Two files are of frame 2"):
        numbered_files(tmp_path / "rgb", _PNG)


def test_the_benchmark_opens_every_frame(capsys: pytest.CaptureFixture[str]) -> None:
    large_capture(cameras=3, frames=5, rounds=1, as_json=True)
    assert '"frames": 5' in capsys.readouterr().out
