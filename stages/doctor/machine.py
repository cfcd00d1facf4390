"""Processor, memory, disk: read from the operating system, without loading anything heavy."""

from __future__ import annotations

import os
import platform
import tempfile
from dataclasses import dataclass
from pathlib import Path

from stages.shared.artifacts.files import free_bytes

_INSTRUCTIONS = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512_bf16", "amx_tile", "neon", "asimd")


@dataclass(frozen=True)
class Machine:
    """One computer, as this process sees it.

    Attributes:
        system, processor: names. cores: that this process may use. instructions: vector instruction sets.
        memory_bytes, free_memory_bytes: whole and available; a container's limit counts.
        free_disk_bytes: where results would go. writable: whether a file can be made there.
        thread_limits: environment variables that limit threads.
    """

    system: str
    processor: str
    cores: int
    instructions: tuple[str, ...]
    memory_bytes: int
    free_memory_bytes: int
    free_disk_bytes: int
    writable: bool
    thread_limits: dict[str, str]


def look(folder: Path) -> Machine:
    """The machine, with the disk that holds `folder`."""
    cpu, memory = _fields(Path("/proc/cpuinfo")), _fields(Path("/proc/meminfo"))
    flags = set((cpu.get("flags") or cpu.get("Features") or "").split())
    whole = _kibibytes(memory, "MemTotal")
    limit = _container_limit()
    free = min(_kibibytes(memory, "MemAvailable"), limit or whole)
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Machine(
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        processor=cpu.get("model name") or platform.processor() or "unknown",
        cores=cores,
        instructions=tuple(name for name in _INSTRUCTIONS if name in flags),
        memory_bytes=min(whole, limit or whole),
        free_memory_bytes=free,
        free_disk_bytes=free_bytes(folder),
        writable=_can_write(folder),
        thread_limits={name: os.environ[name] for name in names if name in os.environ},
    )


def _fields(path: Path) -> dict[str, str]:
    """First value of every `name: value` line of a file of /proc; empty where there is no such file."""
    try:
        lines = path.read_text(errors="replace").splitlines()
    except OSError:
        return {}
    found: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if colon:
            found.setdefault(name.strip(), value.strip())
    return found


def _kibibytes(fields: dict[str, str], name: str) -> int:
    words = fields.get(name, "0").split()
    return int(words[0]) * 1024 if words and words[0].isdigit() else 0


def _container_limit() -> int | None:
    """Memory limit of the control group, in bytes."""
    for path in (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes")):
        try:
            text = path.read_text().strip()
        except OSError:
            continue
        if text.isdigit() and int(text) < 1 << 60:
            return int(text)
    return None


def _can_write(folder: Path) -> bool:
    for place in (folder, *folder.absolute().parents):
        if place.is_dir():
            try:
                with tempfile.TemporaryFile(dir=place) as file:
                    file.write(b"x")
            except OSError:
                return False
            return True
    return False
