"""Memory of a run: refused before the start where it cannot fit, and named when it runs out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from stages.shared.errors import UsageProblem
from stages.train.config import PRESETS, TrainConfig
from stages.train.distributed import on_this_machine
from stages.train.estimate import extent_of, memory_bytes
from stages.train.resolve import resolve
from stages.train.source import Source

_REFUSED_ABOVE = 0.9  # of what is free
_TORCH_MESSAGES = ("not enough memory", "can't allocate memory", "out of memory", "bad_alloc")


def available_bytes(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Memory that a new process can have; None where the system does not tell."""
    try:
        lines = meminfo.read_text().splitlines()
    except OSError:
        return None
    rows = [line.split() for line in lines if line.startswith("MemAvailable:")]
    return int(rows[0][1]) * 1024 if rows and len(rows[0]) > 1 and rows[0][1].isdigit() else None


def refuse_if_scarce(needed: int, available: int | None, fixes: Callable[[], dict[str, int]]) -> None:
    """End a run that is not likely to fit, before it starts.

    Arguments:
        needed: estimate of the run, bytes. available: free bytes, None where unknown. fixes: options that
            need less, and the bytes that the run would need with each.

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
    """The first of these options that fits, or other advice."""
    for option, needed in fixes.items():
        if available is None or needed <= _REFUSED_ABOVE * available:
            return f"Use {option}, which needs about {needed / 1e9:.1f} GB."
    return (
        "Learn from fewer frames (--frame-step, --track-step), close other programs, or use another machine."
    )


@contextmanager
def memory_named(needed: int, fixes: Callable[[], dict[str, int]]) -> Iterator[None]:
    """Turn running out of memory into an error that says which option fits.

    Raises:
        UsageProblem: instead of MemoryError and torch's allocation errors.
    """
    try:
        yield
    except (MemoryError, torch.OutOfMemoryError, RuntimeError) as error:
        text = str(error).lower()
        if isinstance(error, RuntimeError) and not any(words in text for words in _TORCH_MESSAGES):
            raise
        raise UsageProblem(
            f"Memory ran out; this run was estimated at {needed / 1e9:.1f} GB.",
            "preset",
            cure(fixes(), available_bytes()),
        ) from error


def smaller_runs(config: TrainConfig, source: Source) -> dict[str, int]:
    """Options that need less memory than a resolved configuration, mildest first, and the peak with each."""
    maps = source.layers.maps
    settings = {"method": config.method, "minutes": config.minutes}
    others = {"--recompute": replace(config, recompute=True)}
    for name in ("balanced", "draft", "tiny"):
        others[f"--preset {name}"] = resolve(replace(PRESETS[name], **settings), source)  # type: ignore[arg-type]
    sizes = {o: memory_bytes(maps, other, extent_of(source.sequence, other)) for o, other in others.items()}
    whole = memory_bytes(maps, config, extent_of(source.sequence, config))
    return {option: size for option, size in sizes.items() if size < whole}


@contextmanager
def guard_memory(config: TrainConfig, source: Source, device: torch.device) -> Iterator[None]:
    """Refuse a run that is not likely to fit, and name the cure where memory runs out inside the block.

    Raises:
        UsageProblem: as `refuse_if_scarce` (on a CPU) and `memory_named`.
    """
    needed = memory_bytes(source.layers.maps, config, extent_of(source.sequence, config))

    def fixes() -> dict[str, int]:
        return smaller_runs(config, source)

    if device.type == "cpu":
        room = available_bytes()
        refuse_if_scarce(needed, room // on_this_machine() if room else None, fixes)
    with memory_named(needed, fixes):
        yield
