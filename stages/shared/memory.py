"""Memory that is free for this process, and work that would not fit refused before it begins."""

from __future__ import annotations

import resource
from pathlib import Path

from stages.shared.errors import UsageProblem

REFUSED_ABOVE = 0.9  # share of the free memory that a run may be estimated at
_MESSAGES = ("not enough memory", "can't allocate memory", "out of memory", "bad_alloc", "cannot allocate")
_MIB = 1 << 20
_announced: list[int] = []  # estimate of the run that is at work, bytes


def available_bytes(
    meminfo: Path = Path("/proc/meminfo"),
    cgroups: Path = Path("/sys/fs/cgroup"),
    statm: Path = Path("/proc/self/statm"),
) -> int | None:
    """Memory that this process can still have, bytes; None where the system does not say.

    The least of what the machine has free, what the control group (of a container) leaves, and what the limit
    on the address space (`ulimit -v`) leaves.
    """
    limits = [_machine(meminfo), _control_group(cgroups), _address_space(statm)]
    known = [limit for limit in limits if limit is not None]
    return max(0, min(known)) if known else None


def require_memory(needed: int, where: str, fix: str) -> None:
    """Refuse a run that is not likely to fit; remember its estimate for `memory_refusal`.

    Arguments:
        needed: estimate of the whole process, bytes. where: options that decide it. fix: what needs less.

    Raises:
        UsageProblem: more than nine tenths of the free memory are needed.
    """
    _announced[:] = [needed]
    available = available_bytes()
    if available is not None and needed > REFUSED_ABOVE * available:
        raise UsageProblem(
            f"This needs about {needed // _MIB} MiB of memory, and {available // _MIB} MiB are free.",
            where,
            fix,
        )


def is_memory_error(error: BaseException) -> bool:
    """Whether an exception says that memory ran out: Python's own, NumPy's, torch's, OpenCV's."""
    if isinstance(error, MemoryError):
        return True
    try:
        text = str(error).lower()
    except Exception:  # an exception that cannot be printed
        return False
    return isinstance(error, Exception) and any(words in text for words in _MESSAGES)


def memory_refusal(where: str) -> UsageProblem:
    """What a command says when memory ran out in spite of the estimate, or without one."""
    needed = (
        f"It was estimated to need {_announced[0] // _MIB} MiB" if _announced else "Its need is not known"
    )
    available = available_bytes()
    free = "" if available is None else f"; {available // _MIB} MiB are free"
    return UsageProblem(
        f"Memory ran out. {needed}{free}.",
        where,
        "Ask for less: smaller --width and --height, fewer --passes or --frames, a smaller --preset; "
        "or close other programs.",
    )


def _machine(meminfo: Path) -> int | None:
    try:
        lines = meminfo.read_text().splitlines()
    except OSError:
        return None
    fields = [line.split() for line in lines if line.startswith("MemAvailable:")]
    return int(fields[0][1]) * 1024 if fields and len(fields[0]) > 1 and fields[0][1].isdigit() else None


def _control_group(folder: Path) -> int | None:
    """What the limit of the control group leaves, by the names of version 2 and of version 1.

    Cached files count as used there, but make room when memory is asked for.
    """
    names = (
        ("memory.max", "memory.current", "memory.stat"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat"),
    )
    for limit, usage, statistics in names:
        most, used = _number(folder / limit), _number(folder / usage)
        if most is not None and used is not None and most < 1 << 60:
            return most - used + _cached(folder / statistics)
    return None


def _number(path: Path) -> int | None:
    try:
        text = path.read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdigit() else None


def _cached(path: Path) -> int:
    try:
        fields = dict(line.split(maxsplit=1) for line in path.read_text().splitlines())
        return int(fields.get("inactive_file", 0))
    except (OSError, ValueError):
        return 0


def _address_space(statm: Path) -> int | None:
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return None
    try:
        pages = int(statm.read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return None
    return limit - pages * resource.getpagesize()
