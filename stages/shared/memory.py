"""The memory that this process may still use. Work that would not fit is refused before it starts."""

from __future__ import annotations

import resource
from pathlib import Path

from stages.shared.errors import UsageProblem

REFUSED_ABOVE = 0.9  # largest estimate of a run, as a share of the free memory
_MESSAGES = ("not enough memory", "can't allocate memory", "out of memory", "bad_alloc", "cannot allocate")
_MIB = 1 << 20
_announced: list[int] = []  # estimate of the current run, bytes


def available_bytes(
    meminfo: Path = Path("/proc/meminfo"),
    cgroups: Path = Path("/sys/fs/cgroup"),
    statm: Path = Path("/proc/self/statm"),
) -> int | None:
    """Bytes that this process can still allocate, or None if the system does not report it.

    The minimum of the free memory of the machine, of what the control group (of a container) allows, and of
    what the limit on the address space (`ulimit -v`) allows.
    """
    limits = [_machine(meminfo), _control_group(cgroups), _address_space(statm)]
    known = [limit for limit in limits if limit is not None]
    return max(0, min(known)) if known else None


def require_memory(needed: int, where: str, fix: str) -> None:
    """Refuse a run that probably does not fit, and store its estimate for `memory_refusal`.

    Arguments:
        needed: estimate of the whole process, bytes. where: options that determine it. fix: what needs less.

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
    """Whether an exception of Python, NumPy, torch or OpenCV means that memory ran out."""
    if isinstance(error, MemoryError):
        return True
    try:
        text = str(error).lower()
    except Exception:  # an exception that cannot be printed
        return False
    return isinstance(error, Exception) and any(words in text for words in _MESSAGES)


def memory_refusal(where: str) -> UsageProblem:
    """The error of a command when memory ran out, with or without an estimate."""
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
    """Bytes that the limit of the control group leaves, for version 2 and version 1.

    Cached files count as used there, but the system frees them on demand.
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
