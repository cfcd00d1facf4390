"""Videos: the colours that players show, the speed of the motion, and memory that is known before."""

from __future__ import annotations

import resource
from pathlib import Path

import av
import numpy as np
import pytest

from stages.shared import memory
from stages.shared.errors import UsageProblem
from stages.shared.outfit.viewpoints import look_at_camera
from stages.shared.pictures.video import VideoWriter
from stages.shared.render_sequence import outputs as module
from stages.shared.render_sequence.outputs import SequenceFrame, SequenceOutputs, video_rate

COLORS = [(200, 30, 40), (20, 160, 60), (30, 60, 200), (250, 250, 250), (5, 5, 5)]


def _bt709(luma: float, blue: float, red: float) -> tuple[float, ...]:
    """Full-range RGB of limited-range Y'CbCr by ITU-R BT.709, eq. 3 (an independent decoder)."""
    y, cb, cr = (luma - 16) / 219, (blue - 128) / 224, (red - 128) / 224
    r, b = y + 1.5748 * cr, y + 1.8556 * cb
    return tuple(255 * value for value in (r, (y - 0.2126 * r - 0.0722 * b) / 0.7152, b))


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
@pytest.mark.parametrize("size", [(64, 48), (1280, 720)])
def test_films_are_tagged_and_encoded_as_bt709(suffix: str, size: tuple[int, int], tmp_path: Path) -> None:
    if suffix == ".mp4" and "libx264" not in av.codecs_available:
        pytest.skip("no H.264 encoder here")
    path = tmp_path / f"film{suffix}"
    width, height = size
    with VideoWriter(path, 25) as film:
        for color in COLORS[: 5 if width < 100 else 2]:
            film.add(np.full((height, width, 3), color, np.uint8))
    with av.open(str(path)) as container:
        context = container.streams.video[0].codec_context
        for frame, color in zip(container.decode(video=0), COLORS, strict=False):
            tags = (context.color_primaries, context.color_trc, context.colorspace, context.color_range)
            assert [int(tag) for tag in tags] == [1, 1, 1, 1]
            planes = [np.frombuffer(bytes(plane), np.uint8)[5] for plane in frame.planes[:3]]
            assert np.allclose(_bt709(*map(float, planes)), color, atol=3)


def test_transparent_films_are_tagged_too(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "film.webm", 25, transparent=True) as film:
        film.add(np.full((48, 64, 4), 120, np.uint8))
    with av.open(str(tmp_path / "film.webm")) as container:
        assert int(container.streams.video[0].codec_context.colorspace) == 1


def _frames(rows: list[int], size: int = 64) -> list[SequenceFrame]:
    camera = look_at_camera("c", np.zeros(3), 0.0, (1, 1, 1), (size, size))
    return [SequenceFrame(row, (camera,)) for row in rows]


@pytest.mark.parametrize(
    ("rows", "rate"),
    [([0, 1, 2, 3], 30), (list(range(0, 40, 4)), 7.5), ([9, 6, 3, 0], 10), ([5], 30), ([0, 2, 4, 9], 15)],
)
def test_a_film_of_every_nth_row_keeps_the_speed_of_the_motion(rows: list[int], rate: float) -> None:
    assert video_rate(30, _frames(rows)) == rate


@pytest.mark.parametrize("passes", [(), ("layers",), ("labels", "depth")])
def test_a_sequence_of_which_no_frame_fits_is_refused(
    passes: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs, frames = SequenceOutputs(passes=passes), _frames([0, 1], 8192)
    needed = module.memory_bytes(frames, 30_000, 3, outputs)
    monkeypatch.setattr(memory, "available_bytes", lambda: int(1.2 * needed))
    module.require_frame(frames, 30_000, 3, outputs)
    monkeypatch.setattr(memory, "available_bytes", lambda: needed)
    with pytest.raises(UsageProblem, match="MiB are free") as caught:
        module.require_frame(frames, 30_000, 3, outputs)
    assert ("--passes" in caught.value.fix) == ("layers" in passes)


def test_fewer_frames_side_by_side_where_memory_is_scarce(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, outputs = _frames([0, 1, 2, 3], 4096), SequenceOutputs()
    one = module.memory_bytes(frames, 0, 3, outputs) - module.memory_bytes(frames, 0, 3, outputs, 0)
    for room, count in ((100, 8), (3.5, 3), (1.5, 1), (0.1, 1)):
        monkeypatch.setattr(module, "available_bytes", lambda room=room: int(room * one))
        assert module.frames_at_a_time(8, frames, 3, outputs) == count


def test_the_address_space_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    statm = tmp_path / "statm"
    statm.write_text(f"{(1 << 30) // resource.getpagesize()} 5 5\n")
    monkeypatch.setattr(memory.resource, "getrlimit", lambda which: (3 << 30, -1))
    assert memory.available_bytes(tmp_path / "none", tmp_path, statm) == 2 << 30
