"""The benchmark of the splatting backends: measures cases one after the other, writes JSON and charts.

Reads nothing. Writes `splat.json` (machine, limit, one entry per case) and, where there is more than one case
to draw, `splat_gaussians.svg` and `splat_pixels.svg`.
"""

from __future__ import annotations

import json
import platform
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numba
import torch

from stages.shared.artifacts import write_whole
from stages.shared.errors import UsageProblem
from stages.shared.report import SILENT, Report
from stages.shared.splat import cpu, cuda
from stages.shared.splat.benchmark.chart import Series, chart
from stages.shared.splat.benchmark.limit import Limit, measure_limit
from stages.shared.splat.benchmark.measure import Case, measure
from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels.compiling import compilations

_REFERENCE_CASE = Case(1000, 40, 3)
"""What the reference can do in a second: every pixel against every Gaussian."""


@dataclass(frozen=True)
class BenchConfig:
    """gaussians x sizes (px) x channels are measured, each `rounds` times; threads: 0 is torch's number."""

    gaussians: tuple[int, ...] = (25_000, 50_000, 100_000, 200_000)
    sizes: tuple[int, ...] = (512,)
    channels: tuple[int, ...] = (3,)
    rounds: int = 9
    threads: int = 0


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
    first = {"seconds": time.perf_counter() - started, "compiled": compilations() > compiled}
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
    slow = measure(_REFERENCE_CASE, 1, limit, "reference")
    fast = measure(_REFERENCE_CASE, config.rounds, limit)
    return {
        "machine": _machine(),
        "threads": torch.get_num_threads(),
        "first_call": first,
        "limit": {str(channels): _limit_numbers(found) for channels, found in limits.items()},
        "cases": rows,
        "reference": slow,
        "reference_case_on_cpu": fast,
        "times_faster_than_reference": slow["forward_backward_milliseconds"]
        / fast["forward_backward_milliseconds"],
        "cuda": cuda.why_not() or "available",
    }


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
        f"lane use {row['forward_lane_use']:.0%}; buffers {row['buffer_bytes'] / 2**20:.0f} MiB"
    )


def _write(output: Path, summary: dict[str, Any]) -> list[Path]:
    output.mkdir(parents=True, exist_ok=True)
    files = [output / "splat.json"]
    write_whole(files[0], (json.dumps(summary, indent=2) + "\n").encode())
    fixed = {"gaussians": ("size", "px"), "pixels": ("gaussians", "Gaussians")}
    for axis, (held, unit) in fixed.items():
        lines = _series(summary["cases"], axis, held, unit)
        if lines:
            files.append(output / f"splat_{axis}.svg")
            title = f"Splatting on the CPU (threads: {summary['threads']})"
            write_whole(files[-1], chart(title, axis, "milliseconds", lines).encode())
    return files


def _series(rows: list[dict[str, Any]], axis: str, held: str, unit: str) -> list[Series]:
    """Forward, and forward + backward, along one axis; a line for each value of the other."""

    def position(row: dict[str, Any]) -> int:
        return row["size"] ** 2 if axis == "pixels" else row["gaussians"]

    found = []
    for key in sorted({(row[held], row["channels"]) for row in rows}):
        chosen = [row for row in rows if (row[held], row["channels"]) == key]
        if len({position(row) for row in chosen}) < 2:
            continue
        for name, label in (("forward", "forward"), ("forward_backward", "with backward")):
            points = [(float(position(row)), float(row[f"{name}_milliseconds"])) for row in chosen]
            found.append(Series(f"{label}, {key[0]} {unit}", points))
    return found
