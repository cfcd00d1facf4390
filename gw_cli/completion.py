"""What the shell offers at the Tab key: presets, subjects, layers, bundles, artifacts.

Every press of the key calls these functions, so they load no library and never fail. What cannot be read is
not offered.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stages.shared.layers import LAYERS, in_order

PRESETS = ("tiny", "draft", "balanced", "paper")
DEVICES = ("auto", "cpu", "cuda")
_MOST_FOLDERS = 200


def presets(incomplete: str) -> list[str]:
    """Names of presets."""
    return [name for name in PRESETS if name.startswith(incomplete)]


def devices(incomplete: str) -> list[str]:
    """Kinds of device."""
    return [name for name in DEVICES if name.startswith(incomplete)]


def subjects(incomplete: str) -> list[str]:
    """Folders that are workspaces of subjects and begin with what was typed."""
    return [str(folder) for folder in _folders(incomplete) if (folder / "subject.json").is_file()]


def layers(ctx: Any, incomplete: str) -> list[str]:
    """Layers of the subject that was named, or all there can be."""
    named = [ctx.params.get("subject"), *ctx.args] if ctx is not None else []
    there = next((layers_of(Path(str(subject))) for subject in named if subject), [])
    return [name for name in there or LAYERS if name.startswith(incomplete)]


def bundles(incomplete: str) -> list[str]:
    """Garments and bodies (.gwg), and folders on the way to them."""
    files = [str(path) for path in _beside(incomplete) if path.suffix == ".gwg" and path.is_file()]
    return files + [f"{folder}/" for folder in _folders(incomplete)]


def trainings(ctx: Any, incomplete: str) -> list[str]:
    """Keys of the trainings of the subject that was named."""
    subject = None if ctx is None else ctx.params.get("subject")
    if not subject:
        return []
    folders = _folders(f"{subject}/train/{incomplete}")
    return [folder.name for folder in folders if (folder / "manifest.json").is_file()]


def artifacts(incomplete: str) -> list[str]:
    """Subjects and bundles."""
    return subjects(incomplete) + bundles(incomplete)


def layers_of(subject: Path) -> list[str]:
    """Layers that were baked for a subject, in the order of dressing."""
    try:
        key = json.loads((subject / "bake-maps" / "current.json").read_text())["key"]
        manifest = json.loads((subject / "bake-maps" / str(key) / "manifest.json").read_text())
        there = manifest["summary"]["layers"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return in_order(there)


def _folders(incomplete: str) -> list[Path]:
    return [path for path in _beside(incomplete) if path.is_dir() and not path.name.startswith(".")]


def _beside(incomplete: str) -> Iterator[Path]:
    """Paths that begin with what was typed."""
    typed = Path(incomplete)
    parent, start = (typed, "") if incomplete.endswith("/") or not incomplete else (typed.parent, typed.name)
    try:
        names = sorted(path.name for path in parent.iterdir() if path.name.startswith(start))
    except OSError:
        return
    for name in names[:_MOST_FOLDERS]:
        yield parent / name
