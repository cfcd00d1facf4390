"""Fit cloth: make every garment of a trained subject ready for simulation, and choose its default driver.

Reads:
    register-template: `body.safetensors`, `smpl_params.npz`. segment-layers: `<layer>.safetensors`.
    bake-maps: `<layer>.safetensors`. train: `<layer>.safetensors`, `model.json`.
    capture: calibration and label images of some frames of the template's take, if there are any.
Writes:
    `<layer>.safetensors`: a `ClothPattern`. `cloth.json`: {"garments": {layer: {"material": values,
    "drive": driver}}}.

No true mesh is used: materials, corrections and drivers are compared with label images of the take, or with
the offsets that training tracked where there are none.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stages.fit_cloth.choice import Agreement, FittedGarment, fit_garment
from stages.fit_cloth.config import FitClothConfig
from stages.fit_cloth.materials import candidates
from stages.fit_cloth.mesh import build_pattern
from stages.fit_cloth.outlines import MOST_FRAMES, chosen_cameras, read_outlines, surfaces_beneath
from stages.fit_cloth.tracked import tracked_garment
from stages.pipeline import BAKE_MAPS, FIT_CLOTH, REGISTER_TEMPLATE, SEGMENT_LAYERS, TRAIN
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.artifacts.spec import StageResult
from stages.shared.body import BodyModel, Poses
from stages.shared.capture.template_views import capture_files, template_take
from stages.shared.cloth.material import Material
from stages.shared.layers import garments_of
from stages.shared.outfit.layer import layer_of_training
from stages.shared.outfit.simulation import OutfitSimulation
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report

SPECS = (REGISTER_TEMPLATE, SEGMENT_LAYERS, BAKE_MAPS, TRAIN)
_SECONDS_PER_FRAME = 0.04  # of one garment of 1100 vertices


def run(
    subject: Path,
    config: FitClothConfig = FitClothConfig(),
    report: Report = SILENT,
    force: bool = False,
) -> StageResult:
    """Fit the garments of a subject, the inner ones first.

    Raises:
        MissingInput: the subject is not trained. UsageProblem: an unknown material.
        BadData: a garment that cannot be simulated.
    """
    materials = candidates(config.materials)
    workspace = Workspace(subject)
    inputs = _inputs(workspace)
    rows, capture_files = _label_images(workspace, inputs["register-template"], config)
    external: dict[str, Artifact | ExternalFiles] = {**inputs, **capture_files}
    existing = None if force else workspace.find(FIT_CLOTH, config, external)
    if existing is not None:
        report.say("up to date")
        return StageResult(existing, existing.summary)
    registered, segmented, baked, trained = (inputs[spec.name] for spec in SPECS)
    body = BodyModel.from_arrays(registered.arrays("body.safetensors"))
    poses = load_poses(registered.file("smpl_params.npz"), body)
    pose = poses[[int(registered.summary["frame"])]]
    take = _first_frames(poses, config.frames)
    _, seen = template_take(workspace, registered)
    with workspace.build(FIT_CLOTH, config, external, force=force) as build:
        beneath: OutfitSimulation | None = None
        garments: dict[str, Any] = {}
        summary: dict[str, Any] = {}
        for name in garments_of(trained.json("model.json")["layers"]):
            report.step(f"fitting {name}")
            layer = layer_of_training(name, baked, trained)
            mesh = segmented.arrays(name)
            pattern = build_pattern(name, mesh, layer.maps, body, pose, config.vertices, Material())
            tracked = tracked_garment(layer, body, take, config.parts)
            under = partial(surfaces_beneath, body, take, beneath)
            outlines = (
                None
                if seen is None
                else read_outlines(seen, rows, name, tracked.triangles, layer.maps.pitch, under)
            )
            fitted = fit_garment(tracked, outlines, pattern, beneath, materials, pose, config.detail)
            beneath = fitted.simulation
            build.write_arrays(name, fitted.pattern.arrays())
            garments[name] = {"material": fitted.pattern.material.to_json(), "drive": fitted.drive}
            summary[name] = _figures(fitted)
            report.say(_sentence(name, fitted))
        build.write_json("cloth.json", {"garments": garments})
        build.summary(frames=len(take), **summary)
    return StageResult(build.artifact, build.artifact.summary)


def plan(subject: Path, config: FitClothConfig = FitClothConfig()) -> Plan:
    """What `run` would read, write and cost."""
    candidates(config.materials)
    workspace = Workspace(subject)
    inputs = _inputs(workspace)
    trained = inputs["train"]
    names = garments_of(trained.json("model.json")["layers"])
    simulations = len(config.materials) * len(names)
    frame = _SECONDS_PER_FRAME * config.detail * config.vertices / 1100
    return Plan(
        inputs=[str(part.path) for part in inputs.values()],
        outputs=[str(workspace.root / FIT_CLOTH.name / "<key>" / f"{name}.safetensors") for name in names],
        config=asdict(config),
        seconds=10.0 + simulations * frame * config.frames,
        memory_bytes=700_000_000,
        disk_bytes=800 * config.vertices * len(names),
    )


def _inputs(workspace: Workspace) -> dict[str, Artifact]:
    return {spec.name: workspace.require(spec) for spec in SPECS}


def _label_images(
    workspace: Workspace, registered: Artifact, config: FitClothConfig
) -> tuple[list[int], dict[str, ExternalFiles]]:
    """Frames of the template's take whose label images are compared, and their files."""
    capture, take = template_take(workspace, registered)
    if capture is None or take is None:
        return [], {}
    frames = [frame for frame in take.frames if 0 < frame < config.frames]
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(MOST_FRAMES, len(frames))).round().astype(int))
    rows = [frames[index] for index in chosen]
    views = [
        take.view(name, row) for row in rows for name in chosen_cameras(take) if take.has_image(name, row)
    ]
    files = [view.labels for view in views if view.labels is not None]
    if not files:
        return [], {}
    return rows, capture_files(capture, {"cameras": list(take.calibration_files), "labels": files})


def _first_frames(poses: Poses, count: int) -> Poses:
    return poses if len(poses) <= count else replace(poses[list(range(count))], fps=poses.fps)


def _figures(fitted: FittedGarment) -> dict[str, Any]:
    """Numbers to judge a garment by: metres from the tracked garment, and the wrong share of its outline."""
    return {
        "vertices": len(fitted.pattern.vertices),
        "pins": int(fitted.pattern.pinned.sum()),
        "material": fitted.material,
        "residual": fitted.residual,
        "drive": fitted.drive,
        "drivers": {driver: _rounded(value) for driver, value in fitted.drivers.items()},
        "materials": {label: _rounded(value) for label, value in fitted.trials.items()},
    }


def _sentence(name: str, fitted: FittedGarment) -> str:
    parts = []
    for driver, agreement in fitted.drivers.items():
        outline = "" if agreement.outline is None else f" and {100 * agreement.outline:.1f} % of the outline"
        parts.append(f"{driver} {100 * agreement.tracked:.2f} cm{outline}")
    return f"{name}, away from the take: {', '.join(parts)}; driven by {fitted.drive}"


def _rounded(agreement: Agreement | None) -> dict[str, float | None] | None:
    if agreement is None:
        return None
    outline = agreement.outline
    return {
        "tracked_m": round(agreement.tracked, 5),
        "outline": None if outline is None else round(outline, 5),
    }
