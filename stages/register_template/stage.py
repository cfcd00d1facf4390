"""Register a subject: check that body and masks fit, and obtain the dressed person's surface at one frame.

Reads:
    a capture (cameras, poses, scan, masks and images of the frames looked at), or one mesh of a person
    a body model: given, the capture's own, or the embedded one
Writes (artifact register-template):
    template.safetensors   vertices (V,3) f32 m world, faces (F,3) i32, colors (V,3) u8 sRGB and
                           labels (V,) u8 if known
    smpl_params.npz        poses of all training frames; row `frame` of the summary is the template's frame
    body.safetensors       the body model that the poses are for (`BodyModel.to_arrays`)
    overlay.png            the body's outline over the images, or the mesh beside the fitted body
    preview.png            the template from front and back
    report.json            alignment per camera, what was tried, how the template was made, distances
    poses/<take>.npz       poses of every take, when they were fitted or refined
and a copy of smpl_params.npz at SUBJECT/smpl_params.npz.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.pipeline import REGISTER_TEMPLATE
from stages.register_template.config import POSES, TEMPLATES, RegisterTemplateConfig
from stages.register_template.from_capture import register_capture
from stages.register_template.lone_mesh import register_mesh
from stages.register_template.sources import (
    Registered,
    Source,
    body_of,
    capture_source,
    mesh_source,
)
from stages.register_template.virtual_capture import takes_with_scans, virtual_capture
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.build import Build
from stages.shared.artifacts.result import StageResult
from stages.shared.capture import Capture
from stages.shared.capture.subject import remember_capture
from stages.shared.errors import MissingInput, UsageProblem
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
        UsageProblem: a template, take or frame that there is none of.
    """
    workspace = Workspace(subject)
    if config.virtual_cameras:
        given, format = _virtual(given, subject, config, report, body_model, format, force, fit_body_model)
        fit_body_model = None
    source = _source(given, config, body_model, params, format, fit_body_model)
    check_folder_target(subject)
    settings = {**asdict(config), "body": source.body.digest}
    if not config.hold_out:  # subjects of earlier releases keep their keys
        del settings["hold_out"]
    found = None if force else workspace.find(REGISTER_TEMPLATE, settings, source.inputs)
    if found:
        report.say("register-template is up to date")
    else:
        with workspace.build(REGISTER_TEMPLATE, settings, source.inputs, force) as build:
            made = (
                register_capture(source, config, report)
                if source.capture
                else register_mesh(source, config, report)
            )
            _write(build, source, made)
        found = build.artifact
    if source.capture:
        fitted = found.path / FITTED if found.summary.get("fitted_takes") else None
        convention = str(found.json("report")["convention"])
        remember_capture(workspace, source.capture, convention, fitted, config.hold_out)
    workspace.publish(found, "smpl_params.npz", "smpl_params.npz")
    return StageResult(found, found.summary)


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
    if config.virtual_cameras:
        takes_with_scans(_with_scans(given, config, body_model, format, fit_body_model))
    source = _source(given, config, body_model, params, format, fit_body_model)
    check_folder_target(subject)
    hull = source.template == "hull"
    nodes = 0.6 / config.hull_pitch_m**3
    return Plan(
        inputs=[str(file) for group in source.inputs.values() for file in group.files],
        outputs=[str(subject / REGISTER_TEMPLATE.name), str(subject / "smpl_params.npz")],
        config=asdict(config)
        | {"template": source.template, "frame": source.frame, "body": source.body.source},
        seconds=8.0 + (6e-6 * nodes if hull else 0) + _seconds_of_fit(source, config),
        memory_bytes=700_000_000 + (int(120 * nodes) if hull else 0),
        disk_bytes=10_000_000,
    )


def _virtual(
    given: Path,
    subject: Path,
    config: RegisterTemplateConfig,
    report: Report,
    body_model: Path | None,
    format: str | None,
    force: bool,
    fit_body_model: Path | None,
) -> tuple[Path, str]:
    """Render the capture's scans into `SUBJECT/virtual-capture`; give its path and layout."""
    capture = _with_scans(given, config, body_model, format, fit_body_model)
    check_folder_target(subject)
    folder = Path(subject) / VIRTUAL
    return virtual_capture(capture, folder, config.virtual_cameras, report, force=force), "native"


def _with_scans(
    given: Path,
    config: RegisterTemplateConfig,
    body_model: Path | None,
    format: str | None,
    fit_body_model: Path | None,
) -> Capture:
    """The capture whose scans virtual cameras are put around."""
    if not Path(given).is_dir():
        raise UsageProblem(
            "Virtual cameras are put around the scans of a capture.", str(given), "Give a capture."
        )
    own_cameras = replace(config, hold_out=())  # the option names virtual cameras then
    source = capture_source(Path(given), own_cameras, body_model, format, fit_body_model)
    assert source.capture is not None
    return source.capture


def _source(
    given: Path,
    config: RegisterTemplateConfig,
    body_model: Path | None,
    params: Path | None,
    format: str | None,
    fit_body_model: Path | None = None,
) -> Source:
    """The capture or mesh, its body model, and the template's take and frame."""
    if config.template not in TEMPLATES:
        raise UsageProblem(
            f"There is no template called {config.template!r}.",
            "option --template",
            "Choose one of: " + ", ".join(TEMPLATES) + ".",
        )
    if config.poses not in POSES:
        raise UsageProblem(
            f"Poses cannot be {config.poses!r}.", "option poses", "Choose one of: " + ", ".join(POSES) + "."
        )
    given = Path(given)
    if given.is_dir():
        if params is not None:
            raise UsageProblem(
                "A capture brings its own poses.",
                "option --params",
                "Leave --params out; it is for a lone mesh.",
            )
        return capture_source(given, config, body_model, format, fit_body_model)
    if given.is_file():
        return mesh_source(given, config, body_of(body_model, None), body_model, params)
    raise MissingInput(
        "There is no such capture or mesh.", str(given), "Give the folder of a capture, or a mesh file."
    )


def _seconds_of_fit(source: Source, config: RegisterTemplateConfig) -> float:
    """Rough time of a fit: its first frame, and following the body through the others."""
    if not source.fits_body:
        return 0.0
    frames = 0 if source.capture is None else sum(len(take.frames) for take in source.capture.takes)
    cameras = 0 if source.take is None else len(source.take.training_cameras)
    return 0.2 * config.fit_steps + 0.12 * frames * cameras


def _write(build: Build, source: Source, made: Registered) -> None:
    template = made.template
    arrays: dict[str, NDArray[np.generic]] = {"vertices": template.vertices, "faces": template.faces}
    if template.colors is not None:
        arrays["colors"] = template.colors
    if template.labels is not None:
        arrays["labels"] = template.labels
    build.write_arrays("template", arrays, {name: _ABOUT[name] for name in arrays})
    build.write_arrays("body", source.body.to_arrays())
    build.write_bytes("smpl_params.npz", made.poses.to_npz_bytes())
    build.write_picture("overlay.png", made.overlay)
    build.write_picture("preview.png", two_sided_picture(template.vertices, template.faces, template.colors))
    build.write_json("report.json", made.report)
    for name, poses in made.fitted.items():
        build.write_bytes(f"{FITTED}/{name}.npz", poses.to_npz_bytes())
    build.summary(
        frame=made.frame,
        take=made.take,
        template_source=made.source,
        share_inside=made.share_inside,
        vertices=len(template.vertices),
        faces=len(template.faces),
        frames=len(made.poses),
        fitted_takes=sorted(made.fitted),
        **made.numbers,
    )
