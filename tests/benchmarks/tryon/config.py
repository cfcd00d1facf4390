"""Settings of `python -m tests.benchmarks.tryon`; light."""

from __future__ import annotations

from dataclasses import dataclass

PARTS = ("restore", "swap", "push", "penetration")

# Names of rows and the parts that are on: each part alone, all, and all but one.
VARIANTS: dict[str, tuple[str, ...]] = {
    "none": (),
    **{part: (part,) for part in PARTS},
    "all": PARTS,
    **{f"all but {part}": tuple(other for other in PARTS if other != part) for part in PARTS},
}


@dataclass(frozen=True)
class BenchTryonConfig:
    """What is compared.

    Attributes:
        variants: of `VARIANTS`.
        region: layer whose region is scored by itself; "" for that of the garment of another person.
        frame_step, camera_step: every so many-th frame and camera of the truth.
        pictures: side-by-side pictures.
    """

    variants: tuple[str, ...] = tuple(VARIANTS)
    region: str = ""
    frame_step: int = 1
    camera_step: int = 1
    pictures: int = 3
