"""The most memory this process held while something ran."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from stages.shared.artifacts.resident import resident_bytes

_RESET = Path("/proc/self/clear_refs")


def peak_bytes(call: Callable[[], None]) -> dict[str, int | None]:
    """`peak_bytes` of the whole process during the call, and `peak_growth_bytes` over what it held before.

    Resident memory, as Linux counts it (proc(5): VmHWM, set back by writing 5 to clear_refs); None elsewhere.
    """
    try:
        before = resident_bytes("VmRSS")
        _RESET.write_text("5")
        call()
        peak = resident_bytes("VmHWM")
    except OSError:
        return {"peak_bytes": None, "peak_growth_bytes": None}
    return {"peak_bytes": peak, "peak_growth_bytes": peak - before}
