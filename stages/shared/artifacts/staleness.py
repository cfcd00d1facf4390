"""Which stages are up to date, and why the others are not."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from stages.shared.artifacts.artifact import Artifact
from stages.shared.artifacts.canonical import to_json
from stages.shared.artifacts.external import DigestCache, changes, newcomers
from stages.shared.artifacts.manifest import InputEntry
from stages.shared.artifacts.spec import StageSpec
from stages.shared.artifacts.workspace import Workspace
from stages.shared.errors import BadData, StorageFailure

State = Literal["up to date", "stale", "not made", "damaged"]
_SHOWN_FILES = 5


@dataclass(frozen=True)
class StageState:
    """State of one stage; `reasons` is empty when it is up to date, `key` names the artifact in use."""

    stage: str
    state: State
    reasons: list[str]
    key: str | None = None


def staleness(
    workspace: Workspace, specs: Sequence[StageSpec], configs: Mapping[str, Any] | None = None
) -> list[StageState]:
    """State of each stage, in the order of `specs`: what its artifact recorded against what is there now.

    A stage is stale when an external file it read, an artifact it read, its code version or its schema has
    changed, or (for stages in `configs`, by name) its configuration; and when a stage it read from is not up
    to date itself. Files are read only where size or time changed since they were last read.
    """
    cache = DigestCache(workspace.root)
    states: dict[str, StageState] = {}
    for spec in specs:
        states[spec.name] = _state(workspace, spec, states, (configs or {}).get(spec.name), cache)
    with contextlib.suppress(
        StorageFailure
    ):  # a workspace on a read-only disk is looked at without remembering
        cache.save()
    return list(states.values())


def next_stage(states: Sequence[StageState], specs: Sequence[StageSpec]) -> StageSpec | None:
    """The first stage to run, or None if all are up to date."""
    waiting = {state.stage for state in states if state.state != "up to date"}
    return next((spec for spec in specs if spec.name in waiting), None)


def _state(
    workspace: Workspace, spec: StageSpec, known: Mapping[str, StageState], config: Any, cache: DigestCache
) -> StageState:
    try:
        artifact = workspace.current(spec)
    except BadData as error:
        return StageState(spec.name, "damaged", [f"{error.where}: {error.what}"])
    if artifact is None:
        return StageState(spec.name, "not made", [f"run: {workspace.command(spec)}"])
    damage = [f"{file} changed after it was written" for file in artifact.damaged_files(cache)]
    if damage:
        return StageState(spec.name, "damaged", damage, artifact.key)
    reasons = _own_reasons(artifact, spec, config)
    for name, entry in artifact.manifest.inputs.items():
        if entry.stage is not None:
            reasons += _upstream_reasons(workspace, entry, known)
        else:
            reasons += _external_reasons(workspace, artifact, name, entry, cache)
    return StageState(spec.name, "stale" if reasons else "up to date", reasons, artifact.key)


def _own_reasons(artifact: Artifact, spec: StageSpec, config: Any) -> list[str]:
    manifest = artifact.manifest
    reasons = []
    if manifest.code_version != spec.code_version:
        reasons.append(f"code version {manifest.code_version} -> {spec.code_version}")
    if manifest.schema != spec.schema:
        reasons.append(f"schema {manifest.schema} -> {spec.schema}")
    if config is not None:
        reasons += [f"config: {change}" for change in config_changes(manifest.config, to_json(config))]
    return reasons


def config_changes(old: Any, new: Any, name: str = "") -> list[str]:
    """What differs between two configurations, one line per value."""
    if isinstance(old, dict) and isinstance(new, dict):
        names = sorted(set(old) | set(new))
        return [
            change
            for part in names
            for change in config_changes(old.get(part), new.get(part), f"{name}.{part}" if name else part)
        ]
    return [] if old == new else [f"{name} {old} -> {new}"]


def _upstream_reasons(workspace: Workspace, entry: InputEntry, known: Mapping[str, StageState]) -> list[str]:
    """Why what a stage read from another stage is not what is there now."""
    assert entry.stage is not None
    upstream = known.get(entry.stage)
    if upstream is not None and upstream.state != "up to date":
        return [f"{entry.stage} is {upstream.state}"]
    try:
        current = workspace.current(StageSpec(entry.stage, "", ()))
    except BadData:
        return [f"{entry.stage} is damaged"]
    if current is None:
        return [f"{entry.stage} is not made"]
    if current.digest == entry.digest:
        return []
    return [f"{entry.stage} was made again{_difference(workspace, entry, current)}"]


def _difference(workspace: Workspace, entry: InputEntry, current: Artifact) -> str:
    """What is different in an upstream artifact since it was read, if the earlier one is still there."""
    try:
        before = Artifact(workspace.root / str(entry.stage) / str(entry.key)).manifest
    except BadData:
        return ""
    parts = [f"config: {change}" for change in config_changes(before.config, current.manifest.config)]
    if before.code_version != current.manifest.code_version:
        parts.append(f"code version {before.code_version} -> {current.manifest.code_version}")
    inputs = current.manifest.inputs
    parts += [
        f"{name} changed" for name, old in before.inputs.items() if inputs.get(name, old).digest != old.digest
    ]
    return f" ({'; '.join(parts)})" if parts else ""


def _external_reasons(
    workspace: Workspace, artifact: Artifact, name: str, entry: InputEntry, cache: DigestCache
) -> list[str]:
    """Which of the files that a stage read from outside are not as they were."""
    place = workspace.settings().get(str(entry.root))
    root = workspace.root / place if isinstance(place, str) else None
    if root is None or not root.is_dir():
        return [f"{name}: {entry.root} is not where subject.json says ({place})"]
    listing: dict[str, str] = artifact.json(str(entry.listing))
    complete = artifact.run.get("complete_folders", {}).get(name, [])
    changed = list(changes(listing, Path(root), cache))
    changed += [f"{new} is new" for new in newcomers(listing, Path(root), complete)]
    reasons = [f"{name}: {change}" for change in changed[:_SHOWN_FILES]]
    if len(changed) > _SHOWN_FILES:
        reasons.append(f"{name}: {len(changed) - _SHOWN_FILES} more of {len(listing)} files")
    return reasons
