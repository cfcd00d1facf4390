"""Results and plans as lines for people: units that people use, long lists folded, digests left out."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from stages.shared.plan import Plan

_MADE = ("path", "artifact", "page", "file", "bundle", "mesh")  # keys of a result that name what was written
_DIGEST = re.compile(r"(sha256:)?[0-9a-f]{12,64}")
_LONGEST_LIST = 8
_MOST_PATHS = 8  # rows of a plan
_SCALES = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))


def duration(seconds: float) -> str:
    """Seconds as "0.3 s", "12 s", "3 min 12 s" or "2 h 05 min"."""
    if seconds < 9.5:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def size(count: float) -> str:
    """Bytes as "12.3 MB"."""
    scale, unit = next(((scale, unit) for scale, unit in _SCALES if count >= scale), (1, "bytes"))
    return f"{count / scale:.1f} {unit}" if scale > 1 else f"{count:.0f} {unit}"


def result_lines(result: Mapping[str, Any], verbose: bool = False) -> Iterator[str]:
    """A line per entry, what was made first. Digests, empty entries and long lists need `verbose`."""
    made = [name for name in _MADE if result.get(name) is not None]
    yield from (f"made: {result[name]}" for name in made)
    for name, value in result.items():
        shown = verbose or not (_is_digest(value) or value is None or value in ("", [], {}, ()))
        if name not in made and shown:
            yield f"{_label(name)}: {_readable(name, value, verbose)}"


def plan_lines(plan: Plan, verbose: bool = False) -> Iterator[str]:
    """What a command would read, write and cost. Files of one folder are one line without `verbose`."""
    for title, paths in (("reads", plan.inputs), ("writes", plan.outputs)):
        yield from (f"{title:6} {row}" for row in (paths if verbose else folded_paths(paths)))
    for name, value in plan.config.items():
        yield f"{name} = {_readable(name, value, verbose)}"
    for title, parts in plan.scene.items():
        for name, value in parts.items():
            yield f"{title.replace('_', ' ')}: {name}: {_readable(name, value, verbose)}"
    time = "unknown" if plan.seconds is None else duration(plan.seconds)
    memory, disk = (
        "unknown" if count is None else size(count) for count in (plan.memory_bytes, plan.disk_bytes)
    )
    yield f"estimated time {time}, memory {memory}, disk {disk}"


def folded_paths(paths: Sequence[str]) -> list[str]:
    """The paths; where they are many, files of one kind in one folder are counted instead of listed."""
    rows, depth = list(paths), 0
    while len(rows) > _MOST_PATHS and depth < max(len(Path(path).parents) for path in paths):
        keys = [(str(Path(path).parents[min(depth, len(Path(path).parents) - 1)]), Path(path).suffix)
                for path in paths]  # fmt: skip
        counts = Counter(keys)
        listed = {key: path for key, path in zip(keys, paths, strict=True) if counts[key] == 1}
        rows = [
            listed.get(key) or f"{counts[key]:,} {key[1]} files in {key[0]}" for key in dict.fromkeys(keys)
        ]
        depth += 1
    return [row.replace("  ", " ") for row in rows]


def _label(name: str) -> str:
    words = {"bytes": "size", "seconds": "time"}.get(
        name, name.removesuffix("_bytes").removesuffix("_seconds")
    )
    return words.replace("_", " ")


def _readable(name: str, value: Any, verbose: bool) -> str:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and (name == "bytes" or name.endswith("_bytes")):
        return size(value)
    if number and (name == "seconds" or name.endswith("_seconds")):
        return duration(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if number:
        return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
    if value is None:
        return "none"
    if isinstance(value, Mapping | list | tuple):
        if len(value) > _LONGEST_LIST and not verbose:
            return f"{len(value)} entries (-v lists them)"
        if isinstance(value, Mapping):
            shown = [(str(key), part) for key, part in value.items() if verbose or not _is_digest(part)]
            unit = name if name in ("bytes", "seconds") else ""  # of every entry
            return ", ".join(f"{_label(key)} {_readable(unit or key, part, verbose)}" for key, part in shown)
        return ", ".join(_readable("", part, verbose) for part in value)
    return str(value)


def _is_digest(value: Any) -> bool:
    if isinstance(value, Mapping):
        return bool(value) and all(map(_is_digest, value.values()))
    return isinstance(value, str) and _DIGEST.fullmatch(value) is not None and not value.isdecimal()
