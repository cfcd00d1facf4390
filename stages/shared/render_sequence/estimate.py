"""Memory of a render sequence, known before its first frame.

The constants are peaks measured at 2048 and 4096 pixels a side with one and two frames at a time: 70 bytes a
pixel for a composite with the penetration pass, and 45 more for every layer that is kept for its own picture.
"""

from __future__ import annotations

from collections.abc import Sequence

from stages.shared.memory import REFUSED_ABOVE, available_bytes, require_memory
from stages.shared.render_sequence.outputs import SequenceFrame, SequenceOutputs

_PROCESS = 600_000_000  # libraries and compiled kernels
_PER_GAUSSIAN = 3000
_PER_PIXEL, _PER_PIXEL_AND_LAYER = 80, 45


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
