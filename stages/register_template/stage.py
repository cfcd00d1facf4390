"""Register a subject: check that body and masks fit, and obtain the dressed person's surface at one frame.

Reads:
    a capture (cameras, poses, scan, masks and images of the frames looked at), or one mesh of a person
    a body model: given, the capture's own, or the embedded one
Writes (artifact register-template):
    template.safetensors   vertices (V,3) f32 m world, faces (F,3) i32, colors (V,3) u8 sRGB and
                           labels (V,) u8 if known
    smpl_params.npz        poses of all training frames; row `frame` of the summary is the template's frame
    body.safetensors       the body model that the poses are for (`BodyModel.to_arrays`)
    overlay.png            the body's outline over the images, or the mesh above the fitted body
    preview.png            the template from front and back
    report.json            alignment per camera, what was tried, how the template was made, distances
    poses/<take>.npz       poses of every take, when they were fitted or refined
and a copy of smpl_params.npz at SUBJECT/smpl_params.npz.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.pipeline import REGISTER_TEMPLATE
from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.from_capture import picture_scales_of, register_capture
from stages.register_template.lone_mesh import register_mesh
from stages.register_template.sources import Registration, Source, SourceFiles, open_source
from stages.register_template.virtual_capture import takes_with_scans, virtual_capture
from stages.shared.artifacts import Build, StageResult, Workspace
from stages.shared.artifacts.canonical import to_json
from stages.shared.capture.subject import remember_capture
from stages.shared.meshes.picture import two_sided_picture
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_folder_target

FITTED = "poses"
VIRTUAL = "virtual-capture"
_ABOUT = {
    "vertices": "m world (V,3)",
    "faces": "vertex numbers (F,3)",
    "colors": "sRGB (V,3)",
    "labels": "layer label ids (V,)",
}


def run(
    given: Path,
    subject: Path,
    config: RegisterTemplateConfig = RegisterTemplateConfig(),
    report: Report = SILENT,
    body_model: Path | None = None,
    params: Path | None = None,
    format: str | None = None,
    force: bool = False,
    fit_body_model: Path | None = None,
) -> StageResult:
    """Register the capture or mesh `given` as the workspace `subject`.

    Arguments:
        body_model: file that overrides the capture's own body model and the embedded one.
        params: pose file with the body fit of a mesh; without it the body is fitted.
        format: layout of the capture; None finds out.
        fit_body_model: model that the capture's poses were fitted with, when it is not the one to be used
            (gendered fits, a neutral model in use): the poses are converted.

    Raises:
        MissingInput: the capture, mesh, body model or something in them is not there.
        BadData: damaged input; body and masks that do not fit together.
        UsageProblem: a template, take or frame that does not exist.
    """
    workspace = Workspace(subject)
    files = SourceFiles(given, body_model, params, format, fit_body_model)
    if config.virtual_cameras:
        scanned = files.scanned_capture(config)
        check_folder_target(subject)
        rendered = virtual_capture(
            scanned, workspace.root / VIRTUAL, config.virtual_cameras, report, force=force
        )
        files = SourceFiles(rendered, body_model, params, "native")
    source = open_source(files, config)
    check_folder_target(subject)
    settings = to_json(config) | {"body": source.body.digest}
    if result := workspace.reuse(REGISTER_TEMPLATE, settings, source.inputs, report, force):
        artifact = result.artifact
    else:
        with workspace.build(REGISTER_TEMPLATE, settings, source.inputs, force) as build:
            register = register_capture if source.capture else register_mesh
            _write(build, source, register(source, config, report))
        artifact = build.artifact
    if source.capture:
        fitted = artifact.path / FITTED if artifact.summary.get("fitted_takes") else None
        convention = str(artifact.json("report")["convention"])
        remember_capture(workspace, source.capture, convention, fitted, config.hold_out)
    workspace.publish(artifact, "smpl_params.npz", "smpl_params.npz")
    return StageResult(artifact, artifact.summary)


def plan(
    given: Path,
    subject: Path,
    config: RegisterTemplateConfig = RegisterTemplateConfig(),
    body_model: Path | None = None,
    params: Path | None = None,
    format: str | None = None,
    fit_body_model: Path | None = None,
) -> Plan:
    """What `run` would read, write and cost."""
    files = SourceFiles(given, body_model, params, format, fit_body_model)
    if config.virtual_cameras:
        takes_with_scans(files.scanned_capture(config))
    source = open_source(files, config)
    check_folder_target(subject)
    hull = source.template == "hull"
    nodes = 0.6 / config.hull_pitch_m**3
    return Plan(
        inputs=[str(file) for group in source.inputs.values() for file in group.files],
        outputs=[str(subject / REGISTER_TEMPLATE.name), str(subject / "smpl_params.npz")],
        config=asdict(config)
        | {"template": source.template, "frame": source.frame, "body": source.body.source}
        | {"picture_scale": picture_scales_of(source, config)},
        seconds=8.0 + (6e-6 * nodes if hull else 0) + _seconds_of_fit(source, config),
        memory_bytes=700_000_000 + (int(120 * nodes) if hull else 0),
        disk_bytes=10_000_000,
    )


def _seconds_of_fit(source: Source, config: RegisterTemplateConfig) -> float:
    """Rough time of a fit: its first frame, and following the body through the others."""
    if not source.fits_body:
        return 0.0
    frames = 0 if source.capture is None else sum(len(take.frames) for take in source.capture.takes)
    cameras = 0 if source.take is None else len(source.take.training_cameras)
    return 0.2 * config.fit_steps + 0.12 * frames * cameras


def _write(build: Build, source: Source, registration: Registration) -> None:
    template = registration.template
    arrays: dict[str, NDArray[np.generic] | None] = {name: getattr(template, name) for name in _ABOUT}
    build.write_arrays("template", {n: array for n, array in arrays.items() if array is not None}, _ABOUT)
    build.write_arrays("body", source.body.to_arrays())
    build.write_bytes("smpl_params.npz", registration.poses.to_npz_bytes())
    build.write_picture("overlay.png", registration.overlay)
    build.write_picture("preview.png", two_sided_picture(template.vertices, template.faces, template.colors))
    build.write_json("report.json", registration.report)
    for name, poses in registration.fitted.items():
        build.write_bytes(f"{FITTED}/{name}.npz", poses.to_npz_bytes())
    build.summary(
        frame=registration.frame,
        take=registration.take,
        template_source=source.template,
        share_inside=registration.share_inside,
        vertices=len(template.vertices),
        faces=len(template.faces),
        frames=len(registration.poses),
        fitted_takes=sorted(registration.fitted),
        **registration.numbers,
    )
