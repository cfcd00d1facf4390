"""Which layout a folder has, and the capture in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from stages.shared.body.load import load_body
from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.capture.actorshq import open_actorshq, sequence_folders
from stages.shared.capture.animatable_gaussians import AVATARREX, THUMAN4
from stages.shared.capture.four_d_dress import open_4d_dress, take_folders
from stages.shared.capture.native import is_native, open_native
from stages.shared.capture.take import Capture
from stages.shared.errors import MissingInput, UsageProblem

Reader = Callable[[Path, BodyModel | None, Path | None], Capture]

# In the order they are looked for: what a layout is known by, in words, how to tell, and its reader.
_LAYOUTS: Final[dict[str, tuple[str, Callable[[Path], bool], Reader]]] = {
    "native": ("capture.json", is_native, open_native),
    "actorshq": ("SequenceN/1x/calibration.csv", lambda root: bool(sequence_folders(root)), open_actorshq),
    "4d-dress": ("TakeN/Capture/cameras.pkl", lambda root: bool(take_folders(root)), open_4d_dress),
    "thuman4": (THUMAN4.calibration, THUMAN4.fits, THUMAN4.open),
    "avatarrex": (AVATARREX.calibration, AVATARREX.fits, AVATARREX.open),
}
FORMATS: Final = tuple(_LAYOUTS)
BODY_MODEL_FILES: Final = ("body_model.npz", "body_model.safetensors")


def open_capture(
    path: Path,
    format: str | None = None,
    body: BodyModel | None = None,
    poses: Mapping[str, Poses] | None = None,
    poses_needed: bool = True,
) -> Capture:
    """The capture in a folder; pictures are not read yet.

    Arguments:
        path: the folder.
        format: one of `FORMATS`, or None to find out.
        body: body model for pose files that need one (hands as coefficients); by default the one the capture
            brings as `body_model.npz`.
        poses: take name to poses that stand in for the capture's own.
        poses_needed: whether a take without poses is refused.

    Raises:
        MissingInput: no such folder, no layout recognised, files missing.
        BadData: files that are there, but wrong.
        UsageProblem: an unknown format.
    """
    root = Path(path)
    if format is not None and format not in _LAYOUTS:
        raise UsageProblem(
            f"There is no capture format called {format!r}.",
            "option --format",
            "Choose one of: " + ", ".join(FORMATS) + ".",
        )
    if not root.is_dir():
        raise MissingInput("There is no such folder.", str(root), "Give the folder of a capture.")
    body_model_path = next((root / name for name in BODY_MODEL_FILES if (root / name).is_file()), None)
    if body is None and body_model_path is not None:
        body = load_body(body_model_path)
    if format is None:
        format = detect_format(root)
    capture = _LAYOUTS[format][2](root, body, body_model_path)
    if poses is not None:
        capture = with_poses(capture, poses)
    poseless = [take.name for take in capture.takes if not take.posed]
    if poses_needed and poseless:
        raise MissingInput(
            f"The capture has no body poses ({', '.join(poseless)}).",
            f"{root}: no smpl_params.npz (in 4D-DRESS: no SMPLX/*.pkl)",
            "Put its SMPL-X fit there, or fit the body: gw register-template CAPTURE -o SUBJECT --fit.",
        )
    return capture


def with_poses(capture: Capture, poses: Mapping[str, Poses]) -> Capture:
    """The capture with other poses for the takes named; frames beyond their rows are left out."""
    takes = []
    for take in capture.takes:
        if take.name in poses:
            given = poses[take.name]
            frames = [frame for frame in take.frames if frame < len(given)]
            take = replace(take, poses=given, frames=frames, posed=True)
        takes.append(take)
    return replace(capture, takes=tuple(takes))


def with_held_out(capture: Capture, names: Sequence[str]) -> Capture:
    """The capture with more cameras held out: they are judged by, and not learned from.

    Raises:
        UsageProblem: a camera that a take lacks, or no camera left to learn from.
    """
    takes = []
    for take in capture.takes:
        for name in names:
            take.camera(name)
        training = tuple(name for name in take.training_cameras if name not in names)
        if not training:
            raise UsageProblem(
                "No camera would be left to learn from.", "option --hold-out", "Hold out fewer cameras."
            )
        heldout = tuple(dict.fromkeys((*take.heldout_cameras, *names)))
        takes.append(replace(take, training_cameras=training, heldout_cameras=heldout))
    return replace(capture, takes=tuple(takes))


def detect_format(root: Path) -> str:
    """The name of the layout at `root`, or MissingInput that says what was looked for and what is there."""
    for name, (_, fits, _) in _LAYOUTS.items():
        if fits(root):
            return name
    looked = ", ".join(f"{mark} ({name})" for name, (mark, _, _) in _LAYOUTS.items())
    names = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in root.iterdir())[:8]
    raise MissingInput(
        "This folder is no capture in a layout that can be read.",
        f"{root}; looked for {looked}; found {', '.join(names) or 'nothing'}",
        "Give the folder that holds the capture, or force a layout with --format.",
    )
