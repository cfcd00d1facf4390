"""The capture of a subject: where its settings say it is."""

from __future__ import annotations

import os
from pathlib import Path

from stages.shared.artifacts.workspace import Workspace
from stages.shared.body.model import BodyModel
from stages.shared.capture.convention import AS_IS, capture_in_convention
from stages.shared.capture.open_capture import open_capture
from stages.shared.capture.take import Capture
from stages.shared.errors import MissingInput


def remember_capture(workspace: Workspace, capture: Capture, convention: str = AS_IS) -> None:
    """Note in the subject's settings where its capture is (relative to the subject) and how to read it."""
    workspace.save_settings(
        capture=os.path.relpath(capture.root.resolve(), workspace.root.resolve()).replace(os.sep, "/"),
        capture_format=capture.format,
        camera_convention=convention,
    )


def open_subject_capture(workspace: Workspace, body: BodyModel | None = None) -> Capture:
    """The capture that the subject was registered with.

    Raises:
        MissingInput: the subject was made from a mesh alone, or its capture has moved.
        BadData: as `open_capture`.
    """
    settings = workspace.settings()
    if not settings.get("capture"):
        raise MissingInput(
            "This subject has no capture.",
            str(workspace.root),
            "Register one: gw register-template CAPTURE -o SUBJECT.",
        )
    root = workspace.root / Path(settings["capture"])
    if not root.is_dir():
        raise MissingInput(
            "The capture of this subject has moved.",
            str(root),
            "Put it back, or register it again: gw register-template CAPTURE -o SUBJECT.",
        )
    capture = open_capture(root, settings.get("capture_format"), body)
    return capture_in_convention(capture, settings.get("camera_convention", AS_IS))
