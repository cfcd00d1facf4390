"""The chain on a tiny synthetic subject, every command watched by an audit hook."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
ORDER = ("register-template", "canonicalize", "segment-layers", "bake-maps", "train")
TINY = ("--preset", "tiny")
WATCHED = "watched.jsonl"


def gw(*arguments: str | Path, folder: Path, **environment: str) -> dict[str, Any]:
    """Run one command as a user would; its result, or a failure that shows what it said."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.pipeline.watched", *map(str, arguments), "--json"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY), "GW_WATCHED": str(folder / WATCHED)} | environment,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, f"gw {arguments}: {done.stderr}"
    result = json.loads(done.stdout.strip().splitlines()[-1])["result"]
    assert isinstance(result, dict)
    return result


def make_chain(folder: Path, **environment: str) -> Path:
    """Two tiny people as captures, and subject 1 taken through the five stages."""
    gw("synth", "people", *TINY, folder=folder, **environment)
    gw("register-template", "people/subject_1", "-o", "subject", *TINY, folder=folder, **environment)
    for stage in ORDER[1:]:
        gw(stage, "subject", *TINY, folder=folder, **environment)
    return folder
