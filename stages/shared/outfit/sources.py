"""What a command line names: bundles, a subject, poses, frames, a capture's cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.bundle import Bundle, read_bundle
from stages.shared.capture import Capture, Take
from stages.shared.errors import UsageProblem


def read_bundles(paths: Sequence[Path]) -> list[tuple[str, Bundle]]:
    """Bundles with the names people gave them."""
    return [(str(path), read_bundle(path)) for path in paths]


def parse_betas(text: str) -> NDArray[np.float32] | None:
    """Up to ten shape coefficients "0.5,-1,…", the rest 0; None for an empty text.

    Raises:
        UsageProblem: not numbers, too many, beyond ±20.
    """
    if not text.strip():
        return None
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not 1 <= len(values) <= 10 or not all(abs(value) <= 20 for value in values):
        raise UsageProblem(
            f"{text!r} is no body shape.", "option --betas", "Give up to ten numbers, as --betas 0.5,-1.2."
        )
    return np.array(values + [0.0] * (10 - len(values)), np.float32)


def parse_frames(text: str, count: int) -> list[int]:
    """Rows "START:END:STEP" (as a Python slice) of `count` frames; all for an empty text.

    Raises:
        UsageProblem: not a slice, or no frame is left.
    """
    try:
        parts = [int(part) if part else None for part in text.split(":")] if text else [None]
        if len(parts) > 3 or (len(parts) == 1 and text):
            raise ValueError
        rows = list(range(count))[slice(*parts)]
    except ValueError:
        rows = []
    if not rows:
        raise UsageProblem(
            f"{text!r} leaves no frame of {count}.", "option --frames", "Give START:END:STEP, as 0:100:2."
        )
    return rows


def capture_take(capture: Capture, name: str | None) -> Take:
    """The take of a capture that is asked for: by name, else its only test take, else its only take."""
    if name is not None:
        return capture.take(name)
    for takes in (capture.test_takes, capture.takes):
        if len(takes) == 1:
            return takes[0]
    raise UsageProblem(
        f"The capture has {len(capture.takes)} takes.",
        str(capture.root),
        "Choose one with --take: " + ", ".join(take.name for take in capture.takes) + ".",
    )
