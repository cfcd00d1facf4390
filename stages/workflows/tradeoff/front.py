"""Operating points, their Pareto front, and the choice of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from stages.shared.errors import BadData, MissingInput, UsageProblem


@dataclass(frozen=True)
class OperatingPoint:
    """One measured combination of pitch and decoder.

    Attributes:
        name: of its folder. pitch: mm per texel. decoder: see `Decoder`. gaussians: of all layers.
        psnr_foreground (dB), ssim_foreground, miou, sharpness: means over the novel views; the same of novel
            poses in `novel_pose`, by name.
        frames_per_second: pose to pixels. training_minutes. bundle_bytes: of all layers. peak_bytes: playing.
    """

    name: str
    pitch: float
    decoder: str
    gaussians: int
    psnr_foreground: float
    ssim_foreground: float
    miou: float
    sharpness: float
    novel_pose: dict[str, float]
    frames_per_second: float
    training_minutes: float
    bundle_bytes: int
    peak_bytes: int

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, content: Any, where: str) -> OperatingPoint:
        """From JSON. Raises BadData if it is not an operating point."""
        names = cls.__dataclass_fields__
        values = (
            {name: value for name, value in content.items() if name in names}
            if isinstance(content, dict)
            else {}
        )
        if set(values) != set(names):
            raise BadData("This is not an operating point.", where, "Run gw bench tradeoff again.")
        return cls(**values)


def on_front(points: Sequence[OperatingPoint]) -> list[OperatingPoint]:
    """Points that no other beats in speed, PSNR and SSIM at once, slowest first."""

    def beaten(point: OperatingPoint) -> bool:
        return any(
            other.frames_per_second >= point.frames_per_second
            and other.psnr_foreground >= point.psnr_foreground
            and other.ssim_foreground >= point.ssim_foreground
            and other is not point
            and _merits(other) != _merits(point)
            for other in points
        )

    front = [point for point in points if not beaten(point)]
    return sorted(front, key=lambda point: point.frames_per_second)


def fast_enough(points: Sequence[OperatingPoint], frames_per_second: float) -> OperatingPoint:
    """The best-looking point that plays at this rate.

    Raises:
        MissingInput: no point does. The message names the fastest.
    """
    able = [point for point in points if point.frames_per_second >= frames_per_second]
    if not able:
        fastest = max(points, key=lambda point: point.frames_per_second)
        raise MissingInput(
            f"No operating point plays at {frames_per_second:g} frames a second here.",
            f"the fastest, {fastest.name}, reached {fastest.frames_per_second:.1f}",
            "Ask for less, or measure more points: gw bench tradeoff.",
        )
    return max(able, key=lambda point: point.psnr_foreground)


def good_enough(points: Sequence[OperatingPoint], loss: float) -> OperatingPoint:
    """The fastest point at most `loss` dB below the best one."""
    best = max(point.psnr_foreground for point in points)
    near = [point for point in points if point.psnr_foreground >= best - loss]
    return max(near, key=lambda point: point.frames_per_second)


def chosen_point(
    points: Sequence[OperatingPoint], frames_per_second: float, loss: float | None
) -> OperatingPoint:
    """The point for a rate, a loss (dB), or both. 0 and None are no condition.

    With both conditions it is the best-looking point that satisfies both.

    Raises:
        UsageProblem: no condition. MissingInput: no point satisfies them.
    """
    if loss is None and not frames_per_second:
        raise UsageProblem(
            "It is not said what to choose the operating point by.",
            "options --tradeoff, --fps, --quality",
            "Give --fps 25 (frames a second), --quality 0.3 (dB below the best), or both.",
        )
    if loss is None:
        return fast_enough(points, frames_per_second)
    if not frames_per_second:
        return good_enough(points, loss)
    best = max(point.psnr_foreground for point in points)
    return fast_enough([p for p in points if p.psnr_foreground >= best - loss], frames_per_second)


def given_up(points: Sequence[OperatingPoint], chosen: OperatingPoint) -> str:
    """A sentence about what a choice costs."""
    best = max(points, key=lambda point: point.psnr_foreground)
    if best is chosen:
        return f"{chosen.name}: the best measured, {chosen.frames_per_second:.1f} frames/s"
    return (
        f"{chosen.name}: {chosen.frames_per_second:.1f} frames/s for {best.frames_per_second:.1f}, and "
        f"{best.psnr_foreground - chosen.psnr_foreground:.2f} dB, "
        f"{best.ssim_foreground - chosen.ssim_foreground:.3f} SSIM below {best.name}"
    )


def _merits(point: OperatingPoint) -> tuple[float, float, float]:
    return point.frames_per_second, point.psnr_foreground, point.ssim_foreground
