"""The benchmark of the splatting backends: measures cases one after the other, writes JSON and charts.

Reads nothing. Writes `splat.json` (machine, first calls, limit, one entry per case, peers) and, where there
is more than one case to draw, `splat_gaussians.svg`, `splat_pixels.svg` and `splat_channels.svg`.
"""

from __future__ import annotations

import json
import platform
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numba
import torch

from stages.shared.artifacts import write_whole
from stages.shared.errors import UsageProblem
from stages.shared.report import SILENT, Report
from stages.shared.splat import cpu, cuda
from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels.compiling import compilations
from tests.benchmarks.splat.chart import Series, chart
from tests.benchmarks.splat.first_call import measure_first_call
from tests.benchmarks.splat.limit import Limit, measure_limit
from tests.benchmarks.splat.measure import Case, measure
from tests.benchmarks.splat.peers import why_no_gsplat

_REFERENCE_CASE = Case(1000, 40, 3)
"""What plain torch can do in a second: every pixel against every Gaussian."""
_SLOW_ROUNDS = 3


@dataclass(frozen=True)
class BenchConfig:
    """gaussians x sizes (px) x channels are measured, each `rounds` times; threads: 0 is torch's number.

    cold: also time a first call that must compile.
    """

    gaussians: tuple[int, ...] = (25_000, 100_000, 400_000)
    sizes: tuple[int, ...] = (256, 512, 1024, 2048)
    channels: tuple[int, ...] = (3, 7)
    rounds: int = 5
    threads: int = 0
    cold: bool = True

    def quick(self) -> BenchConfig:
        """What takes seconds: the small end of every axis."""
        return replace(self, gaussians=(5_000, 20_000), sizes=(128, 256), channels=(3,), rounds=3, cold=False)


@dataclass(frozen=True)
class BenchResult:
    """Everything measured, and the files it was written to."""

    summary: dict[str, Any]
    files: list[Path] = field(default_factory=list)


def run(output: Path | None, config: BenchConfig = BenchConfig(), report: Report = SILENT) -> BenchResult:
    """Measure; write to the folder `output` unless it is None. Raises UsageProblem for sizes of zero."""
    for name in ("gaussians", "sizes", "channels", "rounds"):
        values = getattr(config, name)
        if min(values if isinstance(values, tuple) else (values,), default=0) < 1:
            raise UsageProblem(f"{name} must be positive.", name, "Give numbers of one and above.")
    before = torch.get_num_threads()
    torch.set_num_threads(config.threads or before)
    try:
        summary = _measure_all(config, report)
    finally:
        torch.set_num_threads(before)
    files = [] if output is None else _write(output, summary)
    return BenchResult(summary, files)


def _measure_all(config: BenchConfig, report: Report) -> dict[str, Any]:
    report.step("preparing the kernels")
    compiled, started = compilations(), time.perf_counter()
    cpu.warm_up(report, config.channels)
    first: dict[str, Any] = {
        "seconds": time.perf_counter() - started,
        "compiled": compilations() > compiled,
        "new_process": measure_first_call(cold=False),
        "new_process_empty_cache": measure_first_call(cold=True) if config.cold else None,
    }
    report.say(_first_line(first))
    report.step("measuring the machine's limit")
    lanes = layout.host_lanes()
    limits = {channels: measure_limit(channels, lanes) for channels in config.channels}
    report.step("measuring")
    cases = [Case(n, size, c) for n in config.gaussians for size in config.sizes for c in config.channels]
    rows = []
    for done, case in enumerate(cases):
        row = measure(case, config.rounds, limits[case.channels])
        rows.append(row)
        report.say(_line(row))
        report.progress(done + 1, len(cases))
    report.step("comparing with the reference")
    limit = next(iter(limits.values()))
    fast = measure(_REFERENCE_CASE, config.rounds, limit)
    slow = measure(_REFERENCE_CASE, _SLOW_ROUNDS, limit, "reference")
    reason = why_no_gsplat()
    gsplat = {"skipped": reason} if reason else measure(_REFERENCE_CASE, _SLOW_ROUNDS, limit, "gsplat-torch")
    return {
        "machine": _machine(),
        "threads": torch.get_num_threads(),
        "first_call": first,
        "limit": {str(channels): _limit_numbers(found) for channels, found in limits.items()},
        "cases": rows,
        "reference": slow,
        "reference_case_on_cpu": fast,
        "times_faster_than_reference": _times(slow, fast),
        "gsplat_torch": gsplat,
        "times_faster_than_gsplat_torch": None if reason else _times(gsplat, fast),
        "cuda": cuda.why_not() or "available",
    }


def _times(slow: dict[str, Any], fast: dict[str, Any]) -> float:
    return float(slow["forward_backward_milliseconds"] / fast["forward_backward_milliseconds"])


def _first_line(first: dict[str, Any]) -> str:
    """The first calls, for people."""
    text = f"first call in a new process: {first['new_process']['seconds']:.1f} s, kernels "
    text += "compiled" if first["new_process"]["compiled"] else "read from disk"
    cold = first["new_process_empty_cache"]
    return text + (f"; {cold['seconds']:.1f} s when they must be compiled" if cold else "")


def _machine() -> dict[str, str]:
    names = ("model name",)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith(names)), "")
    except OSError:
        model = platform.processor()
    return {
        "processor": model,
        "system": platform.platform(),
        "torch": torch.__version__,
        "numba": numba.__version__,
    }


def _limit_numbers(limit: Limit) -> dict[str, float]:
    return asdict(limit)


def _line(row: dict[str, Any]) -> str:
    """One case for people."""
    return (
        f"{row['gaussians']:>8} Gaussians, {row['size']} px, {row['channels']} channels: "
        f"forward {row['forward_milliseconds']:.1f} ms ({row['frames_per_second']:.0f} frames/s), "
        f"with backward {row['forward_backward_milliseconds']:.1f} ms; "
        f"{row['forward_pairs_per_second'] / 1e6:.0f} M pairs/s blended; "
        f"of the in-cache bound {row['fraction_of_hot_bound']['forward']:.0%} forward, "
        f"{row['fraction_of_hot_bound']['backward']:.0%} backward; "
        f"lane use {row['forward_lane_use']:.0%}; buffers {row['buffer_bytes'] / 2**20:.0f} MiB, "
        f"peak of the process {_mebibytes(row['peak_bytes'])} (+ {_mebibytes(row['peak_growth_bytes'])})"
    )


def _mebibytes(size: int | None) -> str:
    return "unknown" if size is None else f"{size / 2**20:.0f} MiB"


def _write(output: Path, summary: dict[str, Any]) -> list[Path]:
    files = [output / "splat.json"]
    write_whole(files[0], (json.dumps(summary, indent=2) + "\n").encode())
    for axis in ("gaussians", "pixels", "channels"):
        lines = _series(summary["cases"], axis)
        if lines:
            files.append(output / f"splat_{axis}.svg")
            title = f"Splatting on the CPU (threads: {summary['threads']})"
            write_whole(files[-1], chart(title, axis, "milliseconds", lines).encode())
    return files


def _series(rows: list[dict[str, Any]], axis: str) -> list[Series]:
    """Forward, and forward + backward, along one axis; the others held at their middle and first value."""
    column = "size" if axis == "pixels" else axis
    held = {name: _middle(rows, name) for name in ("gaussians", "size") if name != column}
    found = []
    for count in [None] if axis == "channels" else sorted({row["channels"] for row in rows}):
        fixed = held if count is None else {**held, "channels": count}
        chosen = [row for row in rows if all(row[name] == value for name, value in fixed.items())]
        if len({row[column] for row in chosen}) < 2:
            continue
        suffix = ", " + ", ".join(_held(name, value) for name, value in fixed.items())
        for name, label in (("forward", "forward"), ("forward_backward", "both")):
            power = 2 if axis == "pixels" else 1
            points = [(float(row[column] ** power), float(row[f"{name}_milliseconds"])) for row in chosen]
            found.append(Series(label + suffix, points))
    return found


def _middle(rows: list[dict[str, Any]], name: str) -> int:
    values = sorted({int(row[name]) for row in rows})
    return values[(len(values) - 1) // 2]


def _held(name: str, value: int) -> str:
    return {"gaussians": f"{value / 1000:g} k", "size": f"{value} px", "channels": f"{value} ch"}[name]
