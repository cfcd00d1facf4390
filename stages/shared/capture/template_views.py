"""The take and frame that a subject's template shows, and the files of that frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.body.model import BodyModel
from stages.shared.capture.subject import open_subject_capture
from stages.shared.capture.take import Capture, Take


def template_take(workspace: Workspace, registered: Artifact) -> tuple[Capture, Take] | tuple[None, None]:
    """The subject's capture and the take its template was made from; None for a subject made of a lone mesh.

    Raises as `open_subject_capture`.
    """
    if not workspace.settings().get("capture"):
        return None, None
    capture = open_subject_capture(workspace, BodyModel.from_arrays(registered.arrays("body")))
    return capture, capture.take(str(registered.summary["take"]))


def frame_files(capture: Capture | None, take: Take | None, frame: int) -> dict[str, ExternalFiles]:
    """What a stage reads when it looks at one frame through the training cameras, by group."""
    if capture is None or take is None:
        return {}
    views = [take.view(name, frame) for name in take.training_cameras if take.has_image(name, frame)]
    groups = {
        "cameras": list(take.calibration_files),
        "images": [view.image for view in views],
        "masks": [view.mask for view in views],
        "labels": [view.labels for view in views if view.labels is not None],
    }
    return capture_files(capture, groups)


def capture_files(capture: Capture, groups: Mapping[str, Sequence[Path]]) -> dict[str, ExternalFiles]:
    """Files of a subject's capture as inputs of a stage: `capture/<group>`, without empty groups.

    Label images that `gw label` made are a group of their own, `labels/images`: they lie in the workspace.
    """
    inputs = {}
    for group, files in groups.items():
        made = [path for path in files if capture.label_folder and path.is_relative_to(capture.label_folder)]
        others = [path for path in files if path not in set(made)]
        if others:
            inputs[f"capture/{group}"] = ExternalFiles(f"capture/{group}", capture.root, others)
        if made and capture.label_folder:
            inputs["labels/images"] = ExternalFiles("labels/images", capture.label_folder, made)
    return inputs
