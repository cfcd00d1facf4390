"""Memory: said before a run starts, and named when it runs out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from stages.shared.errors import UsageProblem

_REFUSED_ABOVE = 0.9  # of what is free
_TORCH_SAYS = ("not enough memory", "can't allocate memory", "out of memory", "bad_alloc")


def available_bytes(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Memory that a new process can have; None where the system does not say."""
    try:
        lines = meminfo.read_text().splitlines()
    except OSError:
        return None
    found = [line.split() for line in lines if line.startswith("MemAvailable:")]
    return int(found[0][1]) * 1024 if found and len(found[0]) > 1 and found[0][1].isdigit() else None


def refuse_if_scarce(needed: int, available: int | None, fixes: Callable[[], dict[str, int]]) -> None:
    """End a run that is not likely to fit, before it starts.

    Arguments:
        needed: estimate of the run, bytes. available: free, or None where nobody knows. fixes: options that
            need less, and what the run would need with each.

    Raises:
        UsageProblem: more than nine tenths of the free memory are needed.
    """
    if available is None or needed <= _REFUSED_ABOVE * available:
        return
    raise UsageProblem(
        f"This run needs about {needed / 1e9:.1f} GB of memory, and {available / 1e9:.1f} GB are free.",
        "preset",
        cure(fixes(), available),
    )


def cure(fixes: dict[str, int], available: int | None) -> str:
    """Which of these options fits, the first in order; or what else could help."""
    for option, needed in fixes.items():
        if available is None or needed <= _REFUSED_ABOVE * available:
            return f"Use {option}, which needs about {needed / 1e9:.1f} GB."
    return (
        "Learn from fewer frames (--frame-step, --track-step), close other programs, or use another machine."
    )


@contextmanager
def memory_named(needed: int, fixes: Callable[[], dict[str, int]]) -> Iterator[None]:
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
            f"Memory ran out; this run was estimated at {needed / 1e9:.1f} GB.",
            "preset",
            cure(fixes(), available_bytes()),
        ) from error
