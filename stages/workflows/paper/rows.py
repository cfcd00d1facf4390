"""Rows of the paper's tables from a subject's trainings; what is evaluated already is not done again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.evaluate import stage
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.canonical import plain
from stages.shared.artifacts.external import file_digest
from stages.shared.report import Report
from stages.workflows.paper.tables import OwnRow
from stages.workflows.paper.trainings import method_of, trainings, without_of


def own_rows(subject: Path, folder: Path, config: Any, report: Report, weights: Path | None) -> list[Any]:
    """Evaluate every training of a subject that is not evaluated yet."""

    rows = []
    for artifact in trainings(Workspace(subject)):
        method, without = method_of(artifact), without_of(artifact)
        report.say(f"{subject.name}: {method}" + (f" without {', '.join(without)}" if without else ""))
        own = replace(config, training=artifact.key)
        place = folder / artifact.key[:12]
        summary = _evaluated(place, own, weights)
        if summary is None:
            summary = stage.run(subject, place, own, report, weights).summary
        seconds = artifact.run.get("training_seconds")
        scores: dict[str, dict[str, float | None]] = {}
        for name in ("novel_pose", "novel_view"):
            if name in summary:
                scores[name] = summary[name].get("trained_without_first", summary[name]["trained"])
        minutes = seconds / 60 if seconds is not None else None
        steps, budget = artifact.summary.get("steps"), artifact.manifest.config.get("minutes")
        name = subject.resolve().name
        rows.append(OwnRow(name, artifact.key, method, without, minutes, steps, scores, budget))
    return rows


def _evaluated(place: Path, config: Any, weights: Path | None) -> dict[str, Any] | None:
    """What an earlier run with the same settings wrote."""
    try:
        content = json.loads((place / "evaluation.json").read_bytes())
    except (OSError, ValueError):
        return None
    same = content.get("config") == plain(config)
    same = same and content.get("perceptual_digest") == (file_digest(weights) if weights else None)
    return content if same else None
