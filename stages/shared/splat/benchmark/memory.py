"""The most memory this process held while something ran."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_bytes(call: Callable[[], None]) -> dict[str, int | None]:
    """`peak_bytes` of the whole process during the call, and `peak_growth_bytes` over what it held before.

    Resident memory, as Linux counts it (proc(5): VmHWM, set back by writing 5 to clear_refs); None elsewhere.
    """
    try:
        before = _resident("VmRSS")
        _RESET.write_text("5")
        call()
        peak = _resident("VmHWM")
    except OSError:
        return {"peak_bytes": None, "peak_growth_bytes": None}
    return {"peak_bytes": peak, "peak_growth_bytes": peak - before}


def _resident(name: str) -> int:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(name + ":"))
    return 1024 * int(line.split()[1])
