"""What a subject can be registered from: a capture, or one mesh."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.frame_choice import choose_frame
from stages.shared.artifacts import ExternalFiles
from stages.shared.body import BodyModel, Poses, embedded_body, load_body
from stages.shared.body.convert import convert_poses
from stages.shared.capture import Capture, Take, open_capture
from stages.shared.capture.landmarks import landmarks_file
from stages.shared.capture.open_capture import with_held_out, with_poses
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.meshes.load import check_mesh_file
from stages.shared.meshes.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Source:
    """Everything decided before any work is done.

    Attributes:
        template: "scan", "hull", "body" or "mesh".
        frame: row of the template in the poses; None while there are none to choose it by.
        inputs: the files that are read, for the artifact's key.
        converted: poses of takes that were fitted with another body model, for the one in use.
        fits_body: whether the body has to be fitted; a hull's frame is chosen after that when none is given.
    """

    body: BodyModel
    template: str
    inputs: dict[str, ExternalFiles]
    frame: int | None = 0
    capture: Capture | None = None
    take: Take | None = None
    mesh: Path | None = None
    params: Path | None = None

    fits_body: bool = False
    converted: dict[str, Poses] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Registered:
    """What registration found; `fitted` are poses of takes that are not the capture's own."""

    template: Mesh
    poses: Poses
    frame: int
    take: str | None
    source: str
    share_inside: dict[str, float]
    overlay: NDArray[np.uint8]
    report: dict[str, Any]
    numbers: dict[str, Any] = field(default_factory=dict)
    fitted: dict[str, Poses] = field(default_factory=dict)


def body_of(body_model: Path | None, capture: Capture | None) -> BodyModel:
    """The body model given, the capture's own, or the embedded one, in this order."""
    if body_model is not None:
        return load_body(body_model)
    if capture is not None and capture.body_model_path is not None:
        return load_body(capture.body_model_path)
    return embedded_body()


def capture_source(
    root: Path,
    config: RegisterTemplateConfig,
    body_model: Path | None,
    format: str | None,
    fit_body_model: Path | None = None,
) -> Source:
    """Open a capture and decide on take, frame and kind of template.

    Arguments:
        fit_body_model: model that the capture's poses were fitted with, when it is not the one to be used.
    """
    given = load_body(body_model) if body_model is not None else None
    fits = config.poses != "given"
    fitted_with = None if fit_body_model is None else load_body(fit_body_model)
    capture = open_capture(root, format, fitted_with or given, poses_needed=not fits)
    capture = with_held_out(capture, config.hold_out)
    body = given or body_of(None, capture)
    converted: dict[str, Poses] = {}
    if fitted_with is not None:
        converted = {
            one.name: convert_poses(one.poses, fitted_with, body) for one in capture.takes if one.posed
        }
        capture = with_poses(capture, converted)
    take = _take(capture, config)
    fits = fits and (config.poses == "refine" or any(not one.posed for one in capture.takes))
    template, frame = _template_and_frame(take, body, config, fits)
    looked_at = frames_checked(take, frame if frame is not None else take.frames[0])
    images = [frame] if frame is not None else take.frames
    masks = _views(take, looked_at, "mask")
    if fits:
        masks = [path for one in capture.takes for path in _views(one, one.frames, "mask")]
    inputs = {
        "capture/cameras": _files(capture, "cameras", list(take.calibration_files)),
        "capture/poses": _files(capture, "poses", [p for t in capture.training_takes for p in t.pose_files]),
        "capture/masks": _files(capture, "masks", masks),
        "capture/images": _files(capture, "images", _views(take, images, "image")),
    }
    landmarks = [file for one in capture.takes if (file := landmarks_file(one)) is not None]
    if fits and landmarks:
        inputs["capture/landmarks"] = _files(capture, "landmarks", landmarks)
    if fits and take.scan is not None:
        inputs["capture/scan"] = _files(capture, "scan", [take.scan])
    if template == "scan" and take.scan is not None:
        inputs["capture/scan"] = _files(capture, "scan", [take.scan])
    if body_model is not None:
        inputs["body_model"] = ExternalFiles("body_model", Path(body_model).parent, [Path(body_model)])
    elif capture.body_model_path is not None:
        inputs["capture/body"] = _files(capture, "body", [capture.body_model_path])
    if fit_body_model is not None:
        path = Path(fit_body_model)
        inputs["fit_body_model"] = ExternalFiles("fit_body_model", path.parent, [path])
    return Source(body, template, inputs, frame, capture, take, fits_body=fits, converted=converted)


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
    check_mesh_file(path)
    inputs = {"mesh": ExternalFiles("mesh", path.parent, [path])}
    if params is not None:
        inputs["params"] = ExternalFiles("params", params.parent, [params])
    if body_model is not None:
        inputs["body_model"] = ExternalFiles("body_model", Path(body_model).parent, [Path(body_model)])
    return Source(body, "mesh", inputs, config.frame or 0, mesh=path, params=params, fits_body=params is None)


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


def _template_and_frame(
    take: Take, body: BodyModel, config: RegisterTemplateConfig, fits: bool
) -> tuple[str, int | None]:
    """Kind of template and its frame, as far as the capture allows; None while there are no poses."""
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
    frame = config.frame
    if frame is None and not fits:
        frame = choose_frame(body, take.poses, take.frames)
    return ("body" if config.template == "body" else "hull"), frame


def frames_checked(take: Take, frame: int) -> list[int]:
    """The template's frame and two others, far from each other."""
    others = [take.frames[len(take.frames) // 3], take.frames[(2 * len(take.frames)) // 3]]
    return sorted({frame, *others})


def _files(capture: Capture, group: str, files: list[Path]) -> ExternalFiles:
    return ExternalFiles(f"capture/{group}", capture.root, sorted(set(files)))


def _views(take: Take, frames: list[int], kind: str) -> list[Path]:
    return [
        getattr(take.views[name, frame], kind)
        for name in take.training_cameras
        for frame in frames
        if (name, frame) in take.views
    ]
