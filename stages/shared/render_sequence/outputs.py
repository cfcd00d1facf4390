"""What a render sequence writes, what is counted while it is rendered, and the memory that it needs.

The constants of memory are peaks measured at 2048 and 4096 pixels a side with one and two frames at a time:
70 bytes a pixel for a composite with the penetration pass, and 45 more for every layer with its own picture.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.memory import REFUSED_ABOVE, available_bytes, require_memory
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.pictures.background import WHITE, Background
from stages.shared.splat.settings import SplatSettings

PASSES = ("labels", "depth", "layers")
_PROCESS = 600_000_000  # libraries and compiled kernels
_PER_GAUSSIAN = 3000
_PER_PIXEL, _PER_PIXEL_AND_LAYER = 80, 45


@dataclass(frozen=True, eq=False)
class SequenceFrame:
    """One moment: the row of the pose file, and the cameras that see it."""

    row: int
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class SequenceOutputs:
    """What is written.

    Attributes:
        background: behind video and contact sheet; the frames are transparent.
        passes: of `PASSES`.
        penetration: tolerances of the penetration pass, None to leave it out.
        video_name: name of the video without its suffix. video: of `VIDEOS`.
        camera_folders: one folder per camera, as a capture has them.
        exports: splat formats in which every frame's Gaussians are written. up: their axis that points up,
            of `stages.shared.export.splats.UPS`.
        pictures: whether pictures are written, or exports only.
        cull: leave out hidden body Gaussians (`stages/shared/outfit/visibility_culling.py`) in a sequence
            that is long enough for that to pay; never where the body alone is shown or exported.
        splatting: cut-offs.
    """

    background: Background = WHITE
    passes: tuple[str, ...] = ()
    penetration: PenetrationConfig | None = None
    video_name: str = "film"
    video: str = "auto"
    camera_folders: bool = False
    exports: tuple[str, ...] = ()
    up: str = "auto"
    pictures: bool = True
    cull: bool = True
    splatting: SplatSettings = field(default_factory=SplatSettings)


@dataclass
class SequenceSummary:
    """Counts and times of a render sequence.

    `seconds` are summed over frames, by part. `wall` is the time that posing and rendering took when several
    frames were rendered at the same time.
    """

    pictures: int = 0
    wall: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    penetrated: dict[str, int] = field(default_factory=dict)
    video: str | None = None

    def add(self, other: SequenceSummary) -> None:
        """Add the counts of another summary."""
        self.pictures += other.pictures
        self.wall += other.wall
        for mine, theirs in ((self.seconds, other.seconds), (self.penetrated, other.penetrated)):
            for name, number in theirs.items():
                mine[name] = mine.get(name, 0) + number  # type: ignore[assignment]

    def clock(self, name: str, started: float) -> None:
        """Add the time since `started` (perf_counter) to a part of the work."""
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    @property
    def rendering(self) -> float:
        """Seconds of posing and rendering, without files."""
        return self.seconds.get("pose", 0.0) + self.seconds.get("render", 0.0)

    def as_dict(self) -> dict[str, Any]:
        """For result.json; penetrated pixels are totals over all pictures."""
        return {
            "pictures": self.pictures,
            "penetrated_pixels": self.penetrated,
            "video": self.video,
            "frames_per_second": round(self.pictures / self.wall, 2) if self.wall else None,
            "seconds": {name: round(value, 3) for name, value in self.seconds.items()},
        }


def video_rate(fps: float, frames: Sequence[SequenceFrame]) -> float:
    """Frames per second at which the frames show the motion at its own speed.

    Arguments:
        fps: of the motion. frames: rows of it; of every second row, the rate is half.
    """
    steps = sorted(abs(after.row - before.row) for before, after in itertools.pairwise(frames))
    return fps / max(1, steps[len(steps) // 2]) if steps else fps


def check_passes(passes: tuple[str, ...]) -> None:
    """Raise UsageProblem for a pass that does not exist."""
    unknown = [name for name in passes if name not in PASSES]
    if unknown:
        raise UsageProblem(
            f"There is no pass called {unknown[0]!r}.",
            "option --passes",
            "Choose of: " + ", ".join(PASSES) + ".",
        )


def memory_bytes(
    frames: Sequence[SequenceFrame],
    gaussians: int,
    layers: int,
    outputs: SequenceOutputs,
    at_a_time: int = 1,
) -> int:
    """Peak memory of the process, bytes, with `at_a_time` frames rendered side by side."""
    return _PROCESS + _PER_GAUSSIAN * gaussians + at_a_time * _frame_bytes(frames, layers, outputs)


def require_frame(
    frames: Sequence[SequenceFrame], gaussians: int, layers: int, outputs: SequenceOutputs
) -> None:
    """Refuse a sequence of which not even one frame fits into the free memory. Raises UsageProblem."""
    passes = "fewer --passes, or " if "layers" in outputs.passes else ""
    require_memory(
        memory_bytes(frames, gaussians, layers, outputs),
        "options --width, --height and --passes",
        f"Use {passes}a smaller --width and --height.",
    )


def frames_at_a_time(
    threads: int, frames: Sequence[SequenceFrame], layers: int, outputs: SequenceOutputs
) -> int:
    """Number of frames that are rendered side by side: one per thread, fewer where memory is scarce."""
    available = available_bytes()
    if available is None:
        return max(1, threads)
    fitting = int(REFUSED_ABOVE * available) // max(1, _frame_bytes(frames, layers, outputs))
    return max(1, min(threads, fitting))


def _frame_bytes(frames: Sequence[SequenceFrame], layers: int, outputs: SequenceOutputs) -> int:
    """Memory of one frame by its largest camera."""
    if not outputs.pictures:
        return 0
    pixels = max((camera.width * camera.height for frame in frames for camera in frame.cameras), default=0)
    alone = layers if "layers" in outputs.passes else 0
    return pixels * (_PER_PIXEL + _PER_PIXEL_AND_LAYER * alone)
