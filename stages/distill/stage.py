"""Distill: turn the networks of a trained subject into blendshapes that play in real time.

Reads:
    register-template: `smpl_params.npz`, `body.safetensors`. bake-maps: `<layer>.safetensors`.
    train: `<layer>.safetensors`, `model.json`. Pose files, if any are given.
Writes, as train does:
    `<layer>.safetensors`: state of a `BlendshapeDecoder`. `model.json`: {"layers": {name: its config}}.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.distill.config import DistillConfig
from stages.distill.fit import Fit, Samples, fit_layer, sample_poses
from stages.pipeline import DISTILL
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.artifacts.spec import StageResult
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report


def run(
    subject: Path,
    config: DistillConfig = DistillConfig(),
    report: Report = SILENT,
    force: bool = False,
    motions: Sequence[Path] = (),
) -> StageResult:
    """Ask the networks about many poses and fit blendshapes to the answers, layer by layer.

    `motions` are pose files beyond the training motion to be faithful in.

    Raises:
        MissingInput: the subject is not trained. BadData: a pose file.
    """
    workspace, source = Workspace(subject), TrainedSubject.open(subject)
    registered, baked, trained = source.artifacts
    body = source.body_model()
    given = [load_poses(path, body, report=report) for path in motions]
    inputs: dict[str, Artifact | ExternalFiles] = {
        "register-template": registered,
        "bake-maps": baked,
        "train": trained,
    }
    for index, path in enumerate(motions):
        inputs[f"motion-{index}"] = ExternalFiles(f"motion-{index}", path.parent, [path])
    found = None if force else workspace.find(DISTILL, config, inputs)
    if found is not None:
        report.say("up to date")
        return StageResult(found, found.summary)
    samples = sample_poses(body, source.poses(), given, config)
    summary: dict[str, Any] = {"poses": len(samples.poses)}
    with workspace.build(DISTILL, config, inputs, force=force) as build:
        layers = {}
        for name in trained.json("model.json")["layers"]:
            report.step(f"distilling {name}")
            fit = _distilled(source.layer(name), samples, config, report)
            build.write_arrays(f"{name}.safetensors", {k: v.numpy() for k, v in fit.model.state().items()})
            if trained.has(own := f"maps-{name}.safetensors"):
                build.write_arrays(own, trained.arrays(own))
            layers[name] = fit.model.config
            summary[name] = _figures(fit)
        grids = trained.json("model.json").get("grids")
        build.write_json("model.json", {"layers": layers, **({"grids": grids} if grids else {})})
        build.summary(**summary)
    return StageResult(build.artifact, build.artifact.summary)


def plan(subject: Path, config: DistillConfig = DistillConfig(), motions: Sequence[Path] = ()) -> Plan:
    """What `run` would read, write and cost."""
    source = TrainedSubject.open(subject)
    body, baked = source.body_model(), source.baked
    for path in motions:
        load_poses(path, body)
    texels = baked.summary["texels"]
    poses = config.training_poses + config.blended_poses
    numbers = 70 + sum(width * most for width, most in zip((3, 3, 8), config.most, strict=True))
    return Plan(
        inputs=[*(str(part.path) for part in source.artifacts), *map(str, motions)],
        outputs=[f"{Workspace(subject).root / DISTILL.name}/<key>/{name}.safetensors" for name in texels],
        config=asdict(config),
        seconds=5.0 + 3e-6 * poses * sum(texels.values()),
        memory_bytes=600_000_000 + 3 * 56 * poses * max(texels.values()),
        disk_bytes=4 * sum(texels.values()) * numbers,
    )


@torch.no_grad()
def _distilled(
    layer: WornLayer,
    samples: Samples,
    config: DistillConfig,
    report: Report,
) -> Fit:
    teacher = layer.model
    count = len(samples.poses)
    residuals = torch.empty(count, len(teacher.maps), 14)
    still: list[torch.Tensor | None] = [None] * count
    motions = samples.motions(teacher.model_config.history) or still
    for index, (pose, motion) in enumerate(zip(samples.poses, motions, strict=True)):
        residuals[index] = teacher.residual(pose, motion=motion)
        report.progress(index + 1, count)
    return fit_layer(teacher, residuals, samples, config)


def _figures(fit: Fit) -> dict[str, Any]:
    """Numbers to judge a layer by: bases, what they leave out, error in poses the kernel was not given."""
    return {
        group: {
            "bases": part.scores.shape[1],
            "energy": float(np.round(part.energy, 5)),
            "left_out_rms": float(f"{part.left_out:.3g}"),
            "unseen_pose_rms": float(f"{fit.unseen_error[group]:.3g}"),
        }
        for group, part in fit.components.items()
    }
