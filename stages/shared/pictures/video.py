"""Video that plays in every browser: H.264 in MP4 where the encoder is there, VP9 in WebM otherwise.

Only VP9 has transparency; browsers show the page behind it.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData, UsageProblem

_BT709 = 1  # primaries, transfer and matrix by ITU-T H.273
_LIMITED_RANGE = 1  # "tv": black is 16, white 235
VIDEOS = ("auto", "h264", "vp9", "none")


def video_suffix() -> str:
    """ ".mp4" where H.264 can be written, else ".webm"."""
    import av

    return ".mp4" if "libx264" in av.codecs_available else ".webm"


def chosen_suffix(video: str, transparent: bool = False) -> str:
    """Suffix of a film for one of `VIDEOS`; "" for none.

    Raises UsageProblem: an unknown word, H.264 where there is no encoder, or H.264 with transparency.
    """
    if video not in VIDEOS:
        raise UsageProblem(
            f"There is no video {video!r}.", "option --video", "Choose of: " + ", ".join(VIDEOS) + "."
        )
    if video == "none":
        return ""
    if video == "vp9" or (video == "auto" and transparent):
        return ".webm"
    if video == "h264" and transparent:
        raise UsageProblem(
            "H.264 has no transparency.", "option --video", "Use --video vp9, or another --background."
        )
    if video == "h264" and video_suffix() != ".mp4":
        raise UsageProblem("There is no H.264 encoder here.", "option --video", "Use --video vp9.")
    return video_suffix()


class VideoWriter:
    """Context manager: frames go to the file as they come, so memory does not grow with the length.

    Arguments:
        path: ends in .mp4 (H.264) or .webm (VP9); inside a temporary folder if it must be whole or absent.
        fps: frames per second.
        transparent: frames have straight alpha; .webm only.
    """

    def __init__(self, path: Path, fps: float, transparent: bool = False) -> None:
        self.path, self.fps, self.transparent = path, fps, transparent
        self._container: Any = None
        self._stream: Any = None
        self._size: tuple[int, int] | None = None

    def __enter__(self) -> VideoWriter:
        import av

        options = {"movflags": "+faststart"} if self.path.suffix == ".mp4" else {}
        self._container = av.open(str(self.path), "w", options=options)
        return self

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Append a frame (H, W, 3) u8 sRGB, (H, W, 4) if transparent; odd sides get one more row or column.

        Raises:
            BadData: a frame of another size than the first.
        """
        import av

        if self._size is None:
            self._size = (picture.shape[1], picture.shape[0])
            self._open_stream(*self._size)
        if (picture.shape[1], picture.shape[0]) != self._size:
            raise BadData(
                f"A frame has {picture.shape[1]} x {picture.shape[0]} pixels, the first {self._size[0]} x "
                f"{self._size[1]}.",
                str(self.path),
                "Give frames of one size.",
            )
        even = np.pad(picture, ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)), mode="edge")
        layout = "rgba" if self.transparent else "rgb24"
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format=layout)
        # What players take for granted from 720 lines on. The stream says it too, so that all show the same.
        frame = frame.reformat(
            format=self._stream.pix_fmt,
            dst_colorspace=av.video.reformatter.Colorspace.ITU709,
            dst_color_range=av.video.reformatter.ColorRange.MPEG,
        )
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None and self._stream is not None:
                for packet in self._stream.encode(None):
                    self._container.mux(packet)
        finally:
            self._container.close()

    def _open_stream(self, width: int, height: int) -> None:
        mp4 = self.path.suffix == ".mp4"
        rate = Fraction(self.fps).limit_denominator(1001)
        self._stream = self._container.add_stream("libx264" if mp4 else "libvpx-vp9", rate=rate)
        self._stream.width, self._stream.height = width + width % 2, height + height % 2
        self._stream.pix_fmt = "yuva420p" if self.transparent else "yuv420p"
        context = self._stream.codec_context
        context.color_primaries = context.color_trc = context.colorspace = _BT709
        context.color_range = _LIMITED_RANGE
        # Threads off: the same frames give the same bytes.
        context.thread_count = 1
        quality = {"crf": "20", "preset": "medium"} if mp4 else {"crf": "30", "b": "0", "deadline": "good"}
        if self.transparent:
            quality["auto-alt-ref"] = "0"  # libvpx cannot look ahead with alpha
        self._stream.options = quality
