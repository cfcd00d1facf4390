"""What a subject can be registered from: a capture, or one mesh."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.fit import fit_body
from stages.register_template.frame_choice import choose_frame
from stages.register_template.surface import MEDIAN_BAR_M, distances, make_surface
from stages.shared.artifacts import ExternalFiles
from stages.shared.body import BodyModel, Poses, embedded_body, load_body, posed_vertices
from stages.shared.capture import Capture, Take, open_capture
from stages.shared.capture.alignment import check_alignment, overlay_picture
from stages.shared.capture.convention import AS_IS, take_in_convention
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.meshes.load import load_mesh
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.picture import two_sided_picture
from stages.shared.meshes.remesh import simplify
from stages.shared.poses import load_poses
from stages.shared.report import Report


@dataclass(frozen=True, eq=False)
class Source:
    """Everything decided before any work is done.

    Attributes:
        template: "scan", "hull", "body" or "mesh".
        frame: row of the template in the poses; None while a mesh has none.
        inputs: the files that are read, for the artifact's key.
    """

    body: BodyModel
    template: str
    inputs: dict[str, ExternalFiles]
    frame: int = 0
    capture: Capture | None = None
    take: Take | None = None
    mesh: Path | None = None
    params: Path | None = None

    @property
    def fits_body(self) -> bool:
        """Whether the body has to be fitted."""
        return self.mesh is not None and self.params is None


@dataclass(frozen=True, eq=False)
class Registered:
    """What registration found."""

    template: Mesh
    poses: Poses
    frame: int
    take: str | None
    source: str
    share_inside: dict[str, float]
    overlay: NDArray[np.uint8]
    report: dict[str, Any]
    numbers: dict[str, Any] = field(default_factory=dict)


def body_of(body_model: Path | None, capture: Capture | None) -> BodyModel:
    """The body model given, the capture's own, or the embedded one, in this order."""
    if body_model is not None:
        return load_body(body_model)
    if capture is not None and capture.body_model_path is not None:
        return load_body(capture.body_model_path)
    return embedded_body()


def capture_source(
    root: Path, config: RegisterTemplateConfig, body_model: Path | None, format: str | None
) -> Source:
    """Open a capture and decide on take, frame and kind of template."""
    given = load_body(body_model) if body_model is not None else None
    capture = open_capture(root, format, given)
    body = given or body_of(None, capture)
    take = _take(capture, config)
    template, frame = _template_and_frame(take, body, config)
    inputs = {
        "capture/cameras": _files(capture, "cameras", list(take.calibration_files)),
        "capture/poses": _files(capture, "poses", [p for t in capture.training_takes for p in t.pose_files]),
        "capture/masks": _files(capture, "masks", _views(take, _frames_checked(take, frame), "mask")),
        "capture/images": _files(capture, "images", _views(take, [frame], "image")),
    }
    if template == "scan" and take.scan is not None:
        inputs["capture/scan"] = _files(capture, "scan", [take.scan])
    if body_model is not None:
        inputs["body_model"] = ExternalFiles("body_model", Path(body_model).parent, [Path(body_model)])
    elif capture.body_model_path is not None:
        inputs["capture/body"] = _files(capture, "body", [capture.body_model_path])
    return Source(body, template, inputs, frame, capture, take)


def mesh_source(
    path: Path, config: RegisterTemplateConfig, body: BodyModel, body_model: Path | None, params: Path | None
) -> Source:
    """A lone mesh, with or without a body fit."""
    if config.template in ("hull", "body"):
        raise UsageProblem(
            f"A lone mesh has no masks to make a template of kind {config.template!r} from.",
            "option --template",
            "Leave --template out.",
        )
    inputs = {"mesh": ExternalFiles("mesh", path.parent, [path])}
    if params is not None:
        inputs["params"] = ExternalFiles("params", params.parent, [params])
    if body_model is not None:
        inputs["body_model"] = ExternalFiles("body_model", Path(body_model).parent, [Path(body_model)])
    return Source(body, "mesh", inputs, config.frame or 0, mesh=path, params=params)


def register_capture(source: Source, config: RegisterTemplateConfig, report: Report) -> Registered:
    """Check the alignment and make the template of a capture."""
    capture, take, body, frame = source.capture, source.take, source.body, source.frame
    assert capture is not None and take is not None
    for note in capture.notes:
        report.say(note)
    report.step("projecting the body into the masks")
    checked = {number: posed_body(body, take.poses[number]) for number in _frames_checked(take, frame)}
    alignment = check_alignment(take, checked, body.faces, config.bar)
    if alignment.convention != AS_IS:
        report.warn(f"camera matrices are read with: {alignment.convention}")
        take = take_in_convention(take, alignment.convention)
    report.say(f"{100 * alignment.mean_inside:.1f} % of the body's silhouette lies inside the masks")

    posed = checked[frame]
    template, how = make_surface(source.template, take, frame, posed, body, config, report)
    numbers = distances(template, posed, body)
    overlay = overlay_picture(take, frame, posed, body.faces, alignment.inside)
    poses, rows = _all_training_poses(capture, take)
    return Registered(
        template,
        poses,
        frame,
        take.name,
        source.template,
        alignment.inside,
        overlay,
        {
            "convention": alignment.convention,
            "tried": alignment.tried,
            "inside": alignment.inside,
            "covered": alignment.covered,
            "frames_checked": list(alignment.frames),
            "rows_of_takes": rows,
            "template": how,
            "body": {"vertices": len(body.template_vertices), "digest": body.digest},
            **numbers,
        },
        {"mean_inside": alignment.mean_inside, **numbers},
    )


def register_mesh(source: Source, config: RegisterTemplateConfig, report: Report) -> Registered:
    """Take a lone mesh as the template; fit the body when no parameters are given."""
    assert source.mesh is not None
    body = source.body
    mesh = load_mesh(source.mesh)
    if source.params is None:
        report.step("fitting the body to the mesh")
        fit = fit_body(body, mesh, config.fit_steps, report)
        mesh, poses, frame, how = fit.mesh, fit.poses, 0, fit.report
    else:
        poses, frame = load_poses(source.params, body), source.frame
        if frame >= len(poses):
            raise UsageProblem(
                f"The pose file has {len(poses)} frames; there is no frame {frame}.",
                "option --frame",
                f"Choose 0 to {len(poses) - 1}.",
            )
        how = {"parameters": "given"}
    mesh, way = simplify(mesh, config.most_faces)
    posed = posed_body(body, poses[frame])
    numbers = distances(mesh, posed, body)
    if numbers["template_to_body_m"] > MEDIAN_BAR_M:
        raise BadData(
            f"Half of the mesh is farther than {100 * numbers['template_to_body_m']:.0f} cm from the body.",
            f"{source.mesh}, {source.params or 'fitted body'}",
            "Check that mesh and parameters are of the same frame and in metres, y up."
            if source.params
            else "Give the fit of the body with --params; this mesh could not be fitted.",
        )
    pictures = [
        two_sided_picture(mesh.vertices, mesh.faces, mesh.colors),
        two_sided_picture(posed, body.faces),
    ]
    width = max(picture.shape[1] for picture in pictures)
    overlay = np.concatenate(
        [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in pictures]
    )
    told = {"convention": AS_IS, "template": {"simplified": way} | how, **numbers}
    return Registered(mesh, poses, frame, None, "mesh", {}, overlay, told, numbers)


def posed_body(body: BodyModel, pose: Poses) -> NDArray[np.float64]:
    """Vertices (V, 3) of the body in the first frame of `pose`, world, metres."""
    with torch.no_grad():
        return posed_vertices(
            body,
            torch.from_numpy(pose.rotations[0]).double(),
            torch.from_numpy(pose.translation[0]).double(),
            torch.from_numpy(pose.betas).double(),
            torch.from_numpy(pose.expression[0]).double(),
        ).numpy()


def _take(capture: Capture, config: RegisterTemplateConfig) -> Take:
    takes = capture.training_takes
    if config.take is not None:
        take = capture.take(config.take)
        if take.split != "train":
            raise UsageProblem(
                f"{take.name} is a test take.",
                "option --take",
                "Choose a training take: " + ", ".join(take.name for take in takes) + ".",
            )
        return take
    if not takes:
        raise MissingInput(
            "The capture has no training take.", str(capture.root), "Mark one of its takes as training."
        )
    return next((take for take in takes if take.scan is not None), takes[0])


def _template_and_frame(take: Take, body: BodyModel, config: RegisterTemplateConfig) -> tuple[str, int]:
    """Kind of template and its frame, as far as the capture allows."""
    if config.frame is not None and config.frame not in take.frames:
        raise UsageProblem(
            f"{take.name} has no frame {config.frame} with images and masks of all cameras.",
            "option --frame",
            f"Choose one of its {len(take.frames)} frames, from {take.frames[0]} to {take.frames[-1]}.",
        )
    scan_frame = take.scan_frame if take.scan is not None and take.scan_frame in take.frames else None
    if config.template in ("auto", "scan") and scan_frame is not None and config.frame in (None, scan_frame):
        return "scan", scan_frame
    if config.template == "scan":
        raise MissingInput(
            "The capture has no scan of this frame." if take.scan else "The capture has no scan.",
            f"{take.name}" + (f": scan of frame {take.scan_frame}" if take.scan else ""),
            "Leave --frame out, or choose --template hull.",
        )
    frame = config.frame if config.frame is not None else choose_frame(body, take.poses, take.frames)
    return ("body" if config.template == "body" else "hull"), frame


def _frames_checked(take: Take, frame: int) -> list[int]:
    """The template's frame and two others, far from each other."""
    others = [take.frames[len(take.frames) // 3], take.frames[(2 * len(take.frames)) // 3]]
    return sorted({frame, *others})


def _all_training_poses(capture: Capture, take: Take) -> tuple[Poses, dict[str, list[int]]]:
    """Poses of all training takes, the template's take first, and each take's rows [first, count]."""
    takes = [take, *(other for other in capture.training_takes if other.name != take.name)]
    rows: dict[str, list[int]] = {}
    first = 0
    for one in takes:
        rows[one.name] = [first, len(one.poses)]
        first += len(one.poses)
    together = Poses(
        np.concatenate([one.poses.rotations for one in takes]),
        np.concatenate([one.poses.translation for one in takes]),
        take.poses.betas,
        np.concatenate([one.poses.expression for one in takes]),
        take.fps,
    )
    return together, rows


def _files(capture: Capture, group: str, files: list[Path]) -> ExternalFiles:
    return ExternalFiles(f"capture/{group}", capture.root, sorted(set(files)))


def _views(take: Take, frames: list[int], kind: str) -> list[Path]:
    return [
        getattr(take.views[name, frame], kind)
        for name in take.training_cameras
        for frame in frames
        if (name, frame) in take.views
    ]
