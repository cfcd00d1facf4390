"""What a subject can be registered from: a capture, or one mesh."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.register_template.config import POSES, TEMPLATES, RegisterTemplateConfig
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


@dataclass(frozen=True)
class SourceFiles:
    """What a user names: a capture or a mesh, and the files that belong to it.

    Attributes:
        given: folder of a capture, or a mesh file.
        body_model: overrides the capture's own body model and the embedded one.
        params: pose file with the body fit of a mesh.
        format: layout of the capture; None finds out.
        fit_body_model: model that the capture's poses were fitted with, when it is not the one to be used.
    """

    given: Path
    body_model: Path | None = None
    params: Path | None = None
    format: str | None = None
    fit_body_model: Path | None = None

    def scanned_capture(self, config: RegisterTemplateConfig) -> Capture:
        """The capture whose scans virtual cameras are put around.

        Raises:
            UsageProblem: it is not a folder. Otherwise as `open_source`.
        """
        if not Path(self.given).is_dir():
            raise UsageProblem(
                "Virtual cameras are put around the scans of a capture.", str(self.given), "Give a capture."
            )
        source = _capture_source(self, replace(config, hold_out=()))  # that option names virtual cameras here
        assert source.capture is not None
        return source.capture

    def models(self) -> dict[str, ExternalFiles]:
        """The named body models, as inputs of the artifact."""
        named = {"body_model": self.body_model, "fit_body_model": self.fit_body_model}
        return {name: _lone_file(name, path) for name, path in named.items() if path is not None}


@dataclass(frozen=True, eq=False)
class Source:
    """Everything that is decided before any work is done.

    Attributes:
        template: "scan", "hull", "body" or "mesh".
        inputs: the files that are read, for the artifact's key.
        frame: row of the template in the poses; None while there are no poses to choose it by.
        converted: poses of takes that were fitted with another body model, for the one in use.
        fits_body: whether the body has to be fitted. The frame of a hull is then chosen after the fit.
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
class Registration:
    """Result of a registration.

    Attributes:
        template: world, metres. poses: of all training frames. frame: row of the template in `poses`.
        take: name of the template's take; None for a lone mesh.
        share_inside: camera to the share of the projected body inside its masks.
        overlay: (H, W, 3) u8 sRGB, the body's outlines over the pictures.
        report: what `report.json` holds. numbers: what the summary holds besides.
        fitted: take to poses, where they are not the capture's own.
    """

    template: Mesh
    poses: Poses
    frame: int
    take: str | None
    share_inside: dict[str, float]
    overlay: NDArray[np.uint8]
    report: dict[str, Any]
    numbers: dict[str, Any] = field(default_factory=dict)
    fitted: dict[str, Poses] = field(default_factory=dict)


def open_source(files: SourceFiles, config: RegisterTemplateConfig) -> Source:
    """The capture or mesh, its body model, and the template's take and frame.

    Raises:
        MissingInput, BadData: a file is not there, or damaged.
        UsageProblem: a template, take or frame that does not exist; options that exclude each other.
    """
    for name, value, choices in (
        ("template", config.template, TEMPLATES),
        ("source of poses", config.poses, POSES),
    ):
        if value not in choices:
            raise UsageProblem(
                f"There is no {name} called {value!r}.",
                f"option --{name.split()[-1]}",
                "Choose one of: " + ", ".join(choices) + ".",
            )
    given = Path(files.given)
    if given.is_dir():
        if files.params is not None:
            raise UsageProblem(
                "A capture brings its own poses.",
                "option --params",
                "Leave --params out; it is for a lone mesh.",
            )
        return _capture_source(files, config)
    if given.is_file():
        return _mesh_source(files, config)
    raise MissingInput(
        "There is no such capture or mesh.", str(given), "Give the folder of a capture, or a mesh file."
    )


def _mesh_source(files: SourceFiles, config: RegisterTemplateConfig) -> Source:
    """A lone mesh, with or without a body fit."""
    if config.template in ("hull", "body"):
        raise UsageProblem(
            f"A lone mesh has no masks to make a template of kind {config.template!r} from.",
            "option --template",
            "Leave --template out.",
        )
    path, params = Path(files.given), files.params
    check_mesh_file(path)
    body = load_body(files.body_model) if files.body_model is not None else embedded_body()
    inputs = {"mesh": _lone_file("mesh", path), **replace(files, fit_body_model=None).models()}
    if params is not None:
        inputs["params"] = _lone_file("params", params)
    return Source(body, "mesh", inputs, config.frame or 0, mesh=path, params=params, fits_body=params is None)


def _capture_source(files: SourceFiles, config: RegisterTemplateConfig) -> Source:
    """Open a capture and decide on take, frame and kind of template."""
    named = load_body(files.body_model) if files.body_model is not None else None
    fitted_with = load_body(files.fit_body_model) if files.fit_body_model is not None else None
    fits = config.poses != "given"
    capture = open_capture(Path(files.given), files.format, fitted_with or named, poses_needed=not fits)
    capture = with_held_out(capture, config.hold_out)
    own = capture.body_model_path
    body = named or (load_body(own) if own is not None else embedded_body())
    converted: dict[str, Poses] = {}
    if fitted_with is not None:
        posed = [take for take in capture.takes if take.posed]
        converted = {take.name: convert_poses(take.poses, fitted_with, body) for take in posed}
        capture = with_poses(capture, converted)
    take = _take(capture, config)
    fits = fits and (config.poses == "refine" or any(not take.posed for take in capture.takes))
    template, frame = _template_and_frame(take, body, config, fits)
    inputs = _capture_inputs(capture, take, template, frame, fits) | files.models()
    if named is None and own is not None:
        inputs["capture/body"] = ExternalFiles("capture/body", capture.root, [own])
    return Source(body, template, inputs, frame, capture, take, fits_body=fits, converted=converted)


def _capture_inputs(
    capture: Capture, take: Take, template: str, frame: int | None, fits: bool
) -> dict[str, ExternalFiles]:
    """The files of a capture that registration reads, by group."""
    checked = frames_checked(take, frame if frame is not None else take.frames[0])
    images = [frame] if frame is not None else take.frames
    groups = {
        "cameras": list(take.calibration_files),
        "poses": [path for one in capture.training_takes for path in one.pose_files],
        "masks": _views(take, checked, "mask"),
        "images": _views(take, images, "image"),
    }
    if fits:
        groups["masks"] = [path for one in capture.takes for path in _views(one, one.frames, "mask")]
        landmarks = [landmarks_file(one) for one in capture.takes]
        groups["landmarks"] = [path for path in landmarks if path is not None]
    if take.scan is not None and (fits or template == "scan"):
        groups["scan"] = [take.scan]
    return {
        f"capture/{group}": ExternalFiles(f"capture/{group}", capture.root, sorted(set(paths)))
        for group, paths in groups.items()
        if paths or group != "landmarks"
    }


def _lone_file(name: str, path: Path) -> ExternalFiles:
    return ExternalFiles(name, Path(path).parent, [Path(path)])


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


def _views(take: Take, frames: list[int], kind: str) -> list[Path]:
    return [
        getattr(take.views[name, frame], kind)
        for name in take.training_cameras
        for frame in frames
        if (name, frame) in take.views
    ]
