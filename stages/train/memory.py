"""Memory: said before a run starts, and named when it runs out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from stages.shared.errors import UsageProblem
from stages.shared.report import Report

_CURE = "Use --preset draft, fewer --views-per-step, a smaller --image-scale, or another machine."
_TORCH_SAYS = ("not enough memory", "can't allocate memory", "out of memory", "bad_alloc")


def available_bytes(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Memory that a new process can have; None where the system does not say."""
    try:
        lines = meminfo.read_text().splitlines()
    except OSError:
        return None
    found = [line.split() for line in lines if line.startswith("MemAvailable:")]
    return int(found[0][1]) * 1024 if found and len(found[0]) > 1 and found[0][1].isdigit() else None


def say_if_scarce(needed: int, available: int | None, report: Report) -> bool:
    """Warn where a run is likely not to fit; True if so."""
    if available is None or needed <= available:
        return False
    report.warn(
        f"this run needs about {needed / 1e9:.1f} GB of memory and {available / 1e9:.1f} GB are free. {_CURE}"
    )
    return True


@contextmanager
def memory_named(needed: int) -> Iterator[None]:
    """Running out of memory becomes an error that says what fits.

    Raises:
        UsageProblem: instead of MemoryError and torch's allocation errors.
    """
    try:
        yield
    except (MemoryError, torch.OutOfMemoryError, RuntimeError) as error:
        text = str(error).lower()
        if isinstance(error, RuntimeError) and not any(words in text for words in _TORCH_SAYS):
            raise
        raise UsageProblem(
            f"Memory ran out; this run was estimated at {needed / 1e9:.1f} GB.", "preset", _CURE
        ) from error
