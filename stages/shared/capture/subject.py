"""The capture of a subject: where its settings say it is."""

from __future__ import annotations

from stages.shared.artifacts.workspace import Workspace
from stages.shared.body.model import BodyModel
from stages.shared.capture.convention import AS_IS, capture_in_convention
from stages.shared.capture.open_capture import open_capture
from stages.shared.capture.take import Capture
from stages.shared.errors import MissingInput


def remember_capture(workspace: Workspace, capture: Capture, convention: str = AS_IS) -> None:
    """Note in the subject's settings where its capture is, its layout, and how its cameras are to be read."""
    workspace.save_settings(capture=capture.root, capture_format=capture.format, camera_convention=convention)


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
    capture = open_capture(workspace.setting_path("capture"), settings.get("capture_format"), body)
    return capture_in_convention(capture, settings.get("camera_convention", AS_IS))
