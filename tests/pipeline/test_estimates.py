"""What `--dry-run` foretells against what the run records: memory and disk of the geometry stages."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gw_cli.child import run_command
from stages.pipeline import BY_NAME
from stages.shared.artifacts import Workspace

_WITHIN = 1.25


@pytest.mark.long
def test_estimates_are_within_a_quarter(subject_a: Path, shared_folder: Path, tmp_path: Path) -> None:
    """On a real capture at `draft`; every stage in a process of its own, so that peaks are its own."""
    subject, wrong = tmp_path / "subject", {}
    given: list[str | Path]
    for name in ("register-template", "canonicalize", "segment-layers", "bake-maps"):
        given = [subject]
        if name == "register-template":
            given = [subject_a, "-o", subject, "--body-model", shared_folder / "body/anny_smplx_format.npz"]
        foretold = run_command(name, *given, "--dry-run").result
        run_command(name, *given)
        artifact = Workspace(subject).require(BY_NAME[name])
        bytes_written = sum(path.stat().st_size for path in artifact.path.rglob("*") if path.is_file())
        for what, found in (("memory_bytes", artifact.run["peak_bytes"]), ("disk_bytes", bytes_written)):
            ratio = foretold[what] / found
            if not 1 / _WITHIN <= ratio <= _WITHIN:
                wrong[f"{name} {what}"] = round(ratio, 2)
    assert not wrong, json.dumps(wrong)
