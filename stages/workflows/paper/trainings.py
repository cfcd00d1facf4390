"""The trainings of a subject that were made from the maps in use, and their rows in the paper's tables."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.evaluate import stage
from stages.evaluate.config import EvaluateInputs
from stages.pipeline import BAKE_MAPS, TRAIN
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.artifacts.canonical import to_json
from stages.shared.artifacts.external import file_digest
from stages.shared.errors import MissingInput
from stages.shared.report import Report
from stages.workflows.paper.tables import OwnRow


def trainings(workspace: Workspace) -> list[Artifact]:
    """Trainings of the maps in use, the shortest list of parts left out first.

    Raises:
        MissingInput: there is none.
    """
    artifacts = _of_these_maps(workspace)
    if not artifacts:
        raise MissingInput(
            "This subject has no training.", str(workspace.root), f"Run: {workspace.command(TRAIN)}"
        )
    return sorted(
        artifacts, key=lambda artifact: (len(without_of(artifact)), method_of(artifact), artifact.key)
    )


def method_of(artifact: Artifact) -> str:
    """The method of a training."""
    return str(artifact.summary.get("method", "gaussian-wardrobe"))


def without_of(artifact: Artifact) -> tuple[str, ...]:
    """The parts that a training left out."""
    return tuple(artifact.summary.get("without", ()))


def training_like(workspace: Workspace, config: Any) -> Artifact | None:
    """The training of the maps in use that a configuration gave, also by an earlier version of the code.

    Method, parts left out, minutes, steps and seed must be equal. Of several such trainings, the one with
    most settings in common is returned; None without a configuration or a training.
    """
    asked = {} if config is None else to_json(config)
    telling = ("method", "without", "minutes", "steps", "seed")

    def alike(artifact: Artifact) -> int:
        had = artifact.manifest.config
        return sum(had.get(name) == value for name, value in asked.items())

    candidates = [
        artifact
        for artifact in _of_these_maps(workspace)
        if asked and all(artifact.manifest.config.get(name) == asked[name] for name in telling)
    ]
    return max(candidates, key=alike, default=None)


def _of_these_maps(workspace: Workspace) -> list[Artifact]:
    maps = workspace.require(BAKE_MAPS).key
    artifacts = [Artifact(path) for path in workspace.artifacts() if path.parent.name == TRAIN.name]
    return [artifact for artifact in artifacts if artifact.manifest.inputs["bake-maps"].key == maps]


def own_rows(subject: Path, folder: Path, config: Any, report: Report, weights: Path | None) -> list[OwnRow]:
    """Rows of all trainings of a subject. A training that is evaluated already is not evaluated again."""
    rows = []
    for artifact in trainings(Workspace(subject)):
        method, without = method_of(artifact), without_of(artifact)
        report.say(f"{subject.name}: {method}" + (f" without {', '.join(without)}" if without else ""))
        own = replace(config, training=artifact.key)
        place = folder / artifact.key[:12]
        summary = _evaluated(place, own, weights)
        if summary is None:
            summary = stage.run(EvaluateInputs(subject), place, own, report, weights).summary
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
    """The result of an earlier run with the same settings, or None."""
    try:
        content = json.loads((place / "evaluation.json").read_bytes())
    except (OSError, ValueError):
        return None
    same = content.get("config") == to_json(config)
    same = same and content.get("perceptual_digest") == (file_digest(weights) if weights else None)
    return content if same else None
