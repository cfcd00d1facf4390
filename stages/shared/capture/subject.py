"""The capture of a subject: where its settings say it is."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path

from stages.shared.artifacts.workspace import Workspace
from stages.shared.body.model import BodyModel
from stages.shared.body.poses import DEFAULT_FPS, Poses
from stages.shared.capture.convention import AS_IS, capture_in_convention
from stages.shared.capture.gather import read_poses
from stages.shared.capture.open_capture import open_capture, with_held_out
from stages.shared.capture.take import Capture
from stages.shared.capture.view_files import NumberedFiles, TakeViews
from stages.shared.errors import MissingInput

LABELS_SETTING = "labels"


def remember_capture(
    workspace: Workspace,
    capture: Capture,
    convention: str = AS_IS,
    fitted: Path | None = None,
    hold_out: Sequence[str] = (),
) -> None:
    """Note in the subject's settings where its capture is, its layout, and how its cameras are to be read.

    Label images that `gw label` made are forgotten when the subject gets another capture.

    Arguments:
        fitted: folder with fitted poses `<take>.npz`; None when the capture's own are used.
        hold_out: cameras that are held out besides those the capture holds out.
    """
    before = workspace.settings().get("capture")
    same_capture = before is None or before == workspace.relative(capture.root)
    workspace.save_settings(
        **({} if same_capture else {LABELS_SETTING: ""}),
        capture=capture.root,
        capture_format=capture.format,
        camera_convention=convention,
        fitted_poses="" if fitted is None else fitted,
        hold_out=",".join(hold_out),
    )


def open_subject_capture(workspace: Workspace, body: BodyModel | None = None) -> Capture:
    """The capture that the subject was registered with, its cameras read as was found right then.

    Raises:
        MissingInput: the subject was made from a mesh alone, or its capture has moved.
        BadData: as `open_capture`.
    """
    settings = workspace.settings()
    if not settings.get("capture"):
        raise MissingInput(
            "This subject was made from a mesh; it has no capture.",
            str(workspace.root),
            "Register it from a capture: gw register-template CAPTURE -o SUBJECT.",
        )
    capture = open_capture(
        workspace.setting_path("capture"), settings.get("capture_format"), body, _fitted(workspace)
    )
    capture = with_held_out(capture, [name for name in settings.get("hold_out", "").split(",") if name])
    if settings.get(LABELS_SETTING):
        capture = _with_labels(capture, workspace.setting_path(LABELS_SETTING))
    return capture_in_convention(capture, settings.get("camera_convention", AS_IS))


def _with_labels(capture: Capture, folder: Path) -> Capture:
    """The capture with label images `<take>/<camera>/<frame>.png` of a folder in place of its own."""
    takes = []
    for take in capture.takes:
        cameras = dict(take.views.cameras)
        for place in sorted((folder / take.name).glob("*/")):
            if place.name in cameras:
                views = cameras[place.name]
                made = {int(path.stem): str(path.absolute()) for path in place.glob("*.png")}
                # An absolute name takes no notice of the folder that it is joined to.
                cameras[place.name] = copy(views)
                cameras[place.name].labels = NumberedFiles(
                    views.labels.folder, {**views.labels.names, **made}
                )
        takes.append(replace(take, views=TakeViews(cameras)))
    return replace(capture, takes=tuple(takes), label_folder=folder.absolute())


def _fitted(workspace: Workspace) -> dict[str, Poses] | None:
    """Poses of the takes that were fitted at registration; None where the capture's own are used."""
    if not workspace.settings().get("fitted_poses"):
        return None
    folder = workspace.setting_path("fitted_poses")
    found = {path.stem: read_poses(path, None, None, DEFAULT_FPS) for path in sorted(folder.glob("*.npz"))}
    return {name: poses for name, poses in found.items() if isinstance(poses, Poses)}
