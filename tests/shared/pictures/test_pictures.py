"""Films that decode to what went in, sheets, and output folders that never destroy anything else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from stages.shared.errors import BadData, UsageProblem
from stages.shared.pictures.background import read_background
from stages.shared.pictures.folder import output_folder
from stages.shared.pictures.parts import Share, finish, parse_share, part_folder
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk
from stages.shared.pictures.video import VideoWriter, chosen_suffix, video_suffix


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


def test_backgrounds(tmp_path: Path) -> None:
    straight = np.zeros((4, 6, 4), np.uint8)
    straight[:, 3:] = (200, 100, 0, 255)
    straight[:, 2] = (200, 100, 0, 51)
    on_blue = read_background("#0000ff").under(straight)
    assert on_blue[0, 0].tolist() == [0, 0, 255] and on_blue[0, 5].tolist() == [200, 100, 0]
    assert on_blue[0, 2].tolist() == [40, 20, 204]
    assert read_background("white").color == (1, 1, 1) and not read_background("grey").transparent
    clear = read_background("transparent")
    assert clear.transparent and len(np.unique(clear.under(np.zeros((32, 32, 4), np.uint8)))) == 2
    picture = np.zeros((10, 40, 3), np.uint8)
    picture[:, 15:25] = 255
    cv2.imwrite(str(tmp_path / "wall.png"), picture)
    wall = read_background(str(tmp_path / "wall.png")).behind(20, 20)
    assert wall.shape == (20, 20, 3) and wall[:, 2:-2].min() == 1  # covers, cut off evenly
    for wrong in ("#12345", "blue", "#gggggg"):
        with pytest.raises(UsageProblem, match="background"):
            read_background(wrong)
    (tmp_path / "text.png").write_text("no picture")
    for missing in ("text.png", "none.jpg"):
        with pytest.raises(BadData, match="background"):
            read_background(str(tmp_path / missing))


def test_which_film(tmp_path: Path) -> None:
    assert chosen_suffix("none") == "" and chosen_suffix("vp9") == ".webm"
    assert chosen_suffix("auto") == video_suffix() and chosen_suffix("auto", transparent=True) == ".webm"
    for video, transparent in (("h264", True), ("mpeg1", False)):
        with pytest.raises(UsageProblem):
            chosen_suffix(video, transparent)


def test_a_transparent_film_keeps_its_alpha(tmp_path: Path) -> None:
    frames = []
    for index in range(4):
        frame = np.zeros((48, 64, 4), np.uint8)
        frame[8:40, 10 + 4 * index : 34 + 4 * index] = (220, 60, 30, 255)
        frames.append(frame)
    path = tmp_path / "film.webm"
    with VideoWriter(path, 25, transparent=True) as film:
        for frame in frames:
            film.add(frame)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.metadata.get("alpha_mode") == "1"
        decoder = av.CodecContext.create("libvpx-vp9", "r")  # ffmpeg's own decoder drops alpha
        decoder.extradata = stream.codec_context.extradata
        decoded = [f for packet in container.demux(stream) for f in decoder.decode(packet)]
    assert len(decoded) == 4 and decoded[0].format.name == "yuva420p"
    alpha = decoded[2].to_ndarray(format="rgba")[..., 3]
    assert np.abs(alpha.astype(int) - frames[2][..., 3]).mean() < 4


def test_shares_split_everything_once() -> None:
    items = list(range(11))
    parts = [parse_share(f"{index}/4").of(items) for index in range(1, 5)]
    assert (
        sorted(item for part in parts for item in part) == items
        and max(map(len, parts)) - min(map(len, parts)) <= 1
    )
    assert parse_share("").whole and parse_share("1/1").whole and not parse_share("1/2").whole
    for wrong in ("0/4", "5/4", "a/b", "3", "1/2/3", "-1/2", "1/99999"):
        with pytest.raises(UsageProblem, match="part of the work"):
            parse_share(wrong)


def test_part_folders_stay_until_they_are_finished(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="killed"), part_folder(out, "k1", Share()) as folder:
        (folder / "a.txt").write_text("a")
        raise ValueError("killed")
    assert not out.exists()
    with part_folder(out, "k2", Share(1, 2)) as folder:
        assert not (folder / "a.txt").exists()  # another key, other content
    with part_folder(out, "k1", Share()) as folder:
        assert (folder / "a.txt").read_text() == "a"
        finish(folder, out, [folder / "a.txt"])
    assert [path.name for path in out.iterdir()] == ["a.txt"] and list(tmp_path.iterdir()) == [out]


def test_the_whole_waits_for_no_part_and_parts_for_no_whole(tmp_path: Path) -> None:
    """In another process, as locks are between processes."""
    code = (
        "import sys, pathlib\nfrom stages.shared.pictures.parts import *\n"
        "with part_folder(pathlib.Path(sys.argv[1]), 'k', Share(int(sys.argv[2]), int(sys.argv[3]))): pass"
    )

    def other(index: int, count: int) -> str:
        words = [sys.executable, "-c", code, str(tmp_path / "out"), str(index), str(count)]
        return subprocess.run(words, capture_output=True, text=True, timeout=60).stderr

    with part_folder(tmp_path / "out", "k", Share(1, 2)):
        assert "Locked" in other(1, 2) and "Locked" in other(1, 1) and other(2, 2) == ""
    with part_folder(tmp_path / "out", "k", Share()):
        assert "Locked" in other(2, 2)
    assert other(1, 1) == ""
