"""Rows of `python -m tests.benchmarks.economy` compared with one another, and as tables; light."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

GOALS = {"step": 3.0, "frame": 2.0}
"""How many times sooner a training step and a frame are wanted with all economies than with none."""
GOAL_PSNR = 0.05
"""dB that all of them together may cost."""


def compared(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with how much slower they are, and how many dB lower, than the first of their part."""
    first = {row["row"]: row for row in rows if row["row"] == _part(row)}
    found = []
    for row in rows:
        base = first[_part(row)]
        more = {"slower": round(row["seconds"] / base["seconds"], 3)}
        if "psnr" in row:
            more["psnr_difference"] = round(base["psnr"] - row["psnr"], 4)
        found.append({**row, **more})
    return found


def summed_up(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """All economies against none, side by side: one entry of each part whose rows are there.

    `rows` as `compared` gives them.
    """
    named = {row["row"]: row for row in rows}
    found = []
    for part, goal in GOALS.items():
        for off in (f"{part}-nothing-saved", f"{part}-same-networks"):
            if part in named and off in named:
                found.append(_ends(part, named[part], named[off], goal))
    return found


def _ends(part: str, on: dict[str, Any], off: dict[str, Any], goal: float) -> dict[str, Any]:
    cost = off["psnr"] - on["psnr"] if "psnr" in on else None
    return {
        "part": part,
        "off_is": off["row"],
        "on_milliseconds": round(1000 * on["seconds"], 2),
        "off_milliseconds": round(1000 * off["seconds"], 2),
        "times_faster": off["slower"],
        "on_peak_bytes": on["peak_bytes"],
        "off_peak_bytes": off["peak_bytes"],
        "on_psnr": on.get("psnr"),
        "off_psnr": off.get("psnr"),
        "costs_decibels": None if cost is None else round(cost, 4),
        "goal_times_faster": goal,
        "goal_met": off["slower"] >= goal and (cost is None or cost <= GOAL_PSNR),
    }


def markdown(result: Mapping[str, Any], names: Mapping[str, str]) -> str:
    """The tables of a result; names: what every row leaves out."""
    lines = [
        "| all economies against none | on, ms | off, ms | times faster | peak MB on / off "
        "| PSNR on / off, dB |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for entry in result["summary"]:
        pair = [entry["on_psnr"], entry["off_psnr"]]
        psnr = " / ".join("" if value is None else f"{value:.3f}" for value in pair)
        lines.append(
            f"| {entry['part']} (off: {names[entry['off_is']]}) | {entry['on_milliseconds']:.1f} | "
            f"{entry['off_milliseconds']:.1f} | {entry['times_faster']:.2f} | "
            f"{entry['on_peak_bytes'] / 1e6:.0f} / {entry['off_peak_bytes'] / 1e6:.0f} | {psnr} |"
        )
    lines += [
        "",
        "| left out | milliseconds | times slower | peak MB | PSNR against the truth, dB "
        "| economies cost, dB |",
    ]
    lines.append("|---|---:|---:|---:|---:|---:|")
    for row in result["rows"]:
        psnr = f"{row['psnr']:.3f} | {0.0 - row['psnr_difference']:.3f}" if "psnr" in row else " | "
        lines.append(
            f"| {_part(row)}: {row['without']} | {1000 * row['seconds']:.1f} | {row['slower']:.2f} | "
            f"{row['peak_bytes'] / 1e6:.0f} | {psnr} |"
        )
    if result["left_out"]:
        lines += ["", "Not measured, for want of time: " + ", ".join(result["left_out"]) + "."]
    return "\n".join(lines) + "\n"


def _part(row: Mapping[str, Any]) -> str:
    return str(row["row"]).split("-")[0]
