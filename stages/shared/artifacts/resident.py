"""Memory that this process holds now, and its peak."""

from __future__ import annotations

import resource
from pathlib import Path

_STATUS = Path("/proc/self/status")


def resident_bytes(name: str) -> int:
    """Of this process: "VmRSS" now, "VmHWM" at most (proc(5)). Raises OSError where Linux does not tell."""
    for line in _STATUS.read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise OSError(f"{_STATUS} has no {name}")


def peak_resident_bytes() -> int:
    """The most that this program held since it was started.

    `getrusage` would count what its parent held when it started it as well: Linux carries that over.
    """
    try:
        return resident_bytes("VmHWM")
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
