"""Films that decode to what went in, sheets, and output folders that never destroy anything else."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from stages.shared.errors import BadData, UsageProblem
from stages.shared.pictures.folder import output_folder
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk
from stages.shared.pictures.video import VideoWriter, video_suffix


def _frames(count: int, height: int, width: int) -> list[np.ndarray]:
    ramp = np.linspace(0, 200, width)[None, :, None].repeat(height, 0).repeat(3, 2)
    return [(ramp + 5 * index).astype(np.uint8) for index in range(count)]


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_film_comes_back_frame_by_frame(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"film{suffix}"
    frames = _frames(7, 64, 48)
    with VideoWriter(path, 30) as film:
        for frame in frames:
            film.add(frame)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        codec, rate, pixels = stream.codec_context.name, stream.average_rate, stream.codec_context.pix_fmt
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert codec in ("h264", "vp9", "libvpx-vp9") and pixels == "yuv420p" and float(rate) == 30
    assert len(decoded) == 7
    for frame, found in zip(frames, decoded, strict=True):
        assert np.abs(found.astype(int) - frame).mean() < 4


def test_mp4_starts_with_its_index_and_is_reproducible(tmp_path: Path) -> None:
    if video_suffix() != ".mp4":
        pytest.skip("this build of ffmpeg has no H.264 encoder")
    contents = []
    for name in ("one.mp4", "two.mp4"):
        with VideoWriter(tmp_path / name, 25) as film:
            for frame in _frames(3, 32, 32):
                film.add(frame)
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]
    assert 0 < contents[0].find(b"moov") < contents[0].find(b"mdat")


def test_odd_sides_and_changing_sides(tmp_path: Path) -> None:
    path = tmp_path / "odd.mp4"
    with VideoWriter(path, 25) as film:
        film.add(np.full((33, 41, 3), 90, np.uint8))
        with pytest.raises(BadData):
            film.add(np.full((33, 40, 3), 90, np.uint8))
    with av.open(str(path)) as container:
        assert (container.streams.video[0].width, container.streams.video[0].height) == (42, 34)


def test_sheet_holds_every_picture_in_order() -> None:
    pictures = [np.full((10, 8 + index, 3), 10 * index, np.uint8) for index in range(5)]
    sheet = contact_sheet(pictures, 3)
    assert sheet.shape == (20, 3 * 12, 3)
    assert [int(sheet[5, 6 + 12 * k, 0]) for k in range(3)] == [0, 10, 20]
    assert [int(sheet[15, 6 + 12 * k, 0]) for k in range(2)] == [30, 40]
    assert contact_sheet(pictures, 3, ["text"] * 5).shape[0] > 20
    assert contact_sheet([], 3).size


def test_chosen_and_shrunk() -> None:
    assert chosen(3, 5) == [0, 1, 2]
    assert chosen(100, 4) == [0, 33, 66, 99]
    assert shrunk(np.zeros((100, 50, 3), np.uint8), 40).shape == (40, 20, 3)
    assert shrunk(np.zeros((10, 5, 3), np.uint8), 40).shape == (10, 5, 3)


def test_only_an_older_output_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for text in ("one", "two"):
        with output_folder(out, "result.json", "mark") as folder:
            (folder / "result.json").write_text('{"format": "mark"}')
            (folder / f"{text}.txt").write_text(text)
    assert [path.name for path in sorted(out.iterdir())] == ["result.json", "two.txt"]
    with pytest.raises(UsageProblem), output_folder(out, "result.json", "other mark"):
        raise AssertionError("unreachable")
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.txt").write_text("years of work")
    with pytest.raises(UsageProblem), output_folder(precious, "result.json", "mark"):
        raise AssertionError("unreachable")
    assert (precious / "thesis.txt").read_text() == "years of work"


def test_failure_leaves_the_older_output(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with output_folder(out, "result.json", "mark") as folder:
        (folder / "result.json").write_text('{"format": "mark"}')
    with pytest.raises(ValueError, match="broken"), output_folder(out, "result.json", "mark") as folder:
        (folder / "half.txt").write_text("half")
        raise ValueError("broken")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert [path.name for path in out.iterdir()] == ["result.json"]
