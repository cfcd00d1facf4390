"""What `gw demo` says at the end: a few lines for people, everything for programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.workflows.demo import stage
from stages.workflows.demo.stage import DemoResult

SCORES: dict[str, Any] = {
    "evaluate subject_1": {
        "path": "evaluation/subject_1",
        "training": {"trained": {"key": "ab", "steps": 20}},
        "novel_view": {
            "trained": {"views": 3, "psnr_foreground": 21.049, "iou": 0.9},
            "baseline": {"views": 3, "psnr_foreground": 14.05, "iou": 0.9},
        },
        "seconds": 4.0,
    },
    "evaluate the try-on": {"tryon_truth": {"views": 3, "psnr_foreground": 14.95}, "seconds": 4.0},
}


def test_people_get_a_line_per_evaluation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    summary = {"page": "demo/index.html", "seconds": 839.0, "peak_bytes": 1, "scores": SCORES}
    monkeypatch.setattr(stage, "run", lambda *_: DemoResult(tmp_path / "index.html", summary))
    people = CliRunner().invoke(app, ["demo", "-o", str(tmp_path)])
    assert people.exit_code == 0, people.output
    assert "evaluate subject_1, novel view: trained 21.05 dB, baseline 14.05 dB\n" in people.stderr
    assert "evaluate the try-on, tryon truth: 14.95 dB\n" in people.stderr
    assert len(people.stderr.splitlines()) <= 8 and "iou" not in people.stderr
    programs = CliRunner().invoke(app, ["demo", "-o", str(tmp_path), "--json"])
    assert json.loads(programs.stdout.splitlines()[-1])["result"]["scores"] == SCORES
