"""Reader for the native layout (docs/formats.md): `capture.json`, `cameras.json`, `takes/<name>/…`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

from stages.shared.body.model import BodyModel
from stages.shared.body.poses import DEFAULT_FPS
from stages.shared.capture.calibration import (
    checked_camera,
    positive_rate,
    refuse_unknown,
    truth_value,
    whole_number,
)
from stages.shared.capture.camera import Camera
from stages.shared.capture.gather import make_take, read_poses
from stages.shared.capture.take import Capture, Take
from stages.shared.capture.view_files import CameraViews, MissingList, numbered_files
from stages.shared.errors import BadData
from stages.shared.input_files import read_json_object

FORMAT: Final = "native"
FORMAT_MARK: Final = "gw-capture"
FORMAT_VERSION: Final = 1
NAME: Final = re.compile(r"[A-Za-z0-9][\w.-]{0,63}")
_CAMERA_FIELDS: Final = ("name", "width", "height", "intrinsics", "camera_from_world", "held_out")
_FRAME: Final = re.compile(r"(\d+)\.(?:png|jpg|jpeg)", re.IGNORECASE)


def is_native(root: Path) -> bool:
    """Whether a folder has the native layout."""
    return (root / "capture.json").is_file()


def open_native(root: Path, body: BodyModel | None, body_model_path: Path | None) -> Capture:
    """The takes that `capture.json` lists."""
    path = root / "capture.json"
    description = read_json_object(path, "a description of the capture")
    if description.get("format") != FORMAT_MARK:
        raise BadData(
            f"format is {description.get('format')!r}, not {FORMAT_MARK!r}.",
            str(path),
            "Give another folder.",
        )
    version = description.get("version")
    if version != FORMAT_VERSION:
        raise BadData(
            f"The capture has version {version!r}, this program reads {FORMAT_VERSION}.",
            str(path),
            "Update gw.",
        )
    takes = description.get("takes")
    if not isinstance(takes, list) or not takes:
        raise BadData("capture.json lists no takes.", str(path), "Add an entry to takes.")
    refuse_unknown(description, ("format", "version", "takes", "about"), str(path), "The capture")
    names = [
        entry["name"] for entry in takes if isinstance(entry, dict) and isinstance(entry.get("name"), str)
    ]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise BadData(f"Two takes are called {twice[:64]!r}.", f"{path}: takes", "List every take once.")
    shared = root / "cameras.json"
    return Capture(
        root, FORMAT, tuple(_read_take(root, entry, shared, path, body) for entry in takes), body_model_path
    )


def _read_take(root: Path, entry: Any, shared: Path, path: Path, body: BodyModel | None) -> Take:
    if (
        not isinstance(entry, dict)
        or not isinstance(entry.get("name"), str)
        or not NAME.fullmatch(entry["name"])
    ):
        raise BadData(
            "A take has no usable name.", f"{path}: takes", "Use letters, digits, dot, dash, underscore."
        )
    where = f"{path}: take {entry['name']}"
    refuse_unknown(entry, ("name", "split", "fps", "scan_frame"), where, "The take")
    name, split, fps = entry["name"], entry.get("split", "train"), positive_rate(entry, "fps", where)
    if split not in ("train", "test"):
        raise BadData(f"split is {split!r}.", f"{path}: take {name}", 'Write "train" or "test".')
    folder = root / "takes" / name
    camera_path = folder / "cameras.json" if (folder / "cameras.json").is_file() else shared
    cameras, heldout = read_cameras(camera_path)
    missing = MissingList.read(folder)
    views = {
        camera: CameraViews(
            numbered_files(folder / "rgb" / camera, _FRAME),
            numbered_files(folder / "masks" / camera, _FRAME),
            numbered_files(folder / "labels" / camera, re.compile(r"(\d+)\.png", re.IGNORECASE)),
            missing,
        )
        for camera in cameras
    }
    scan_frame = whole_number(entry.get("scan_frame", 0))
    if scan_frame is None or scan_frame < 0:
        raise BadData(
            "scan_frame is not a frame number.",
            f"{path}: take {name}",
            "Write the frame that the scan shows.",
        )
    scan = next(
        (folder / f"scan.{kind}" for kind in ("ply", "obj") if (folder / f"scan.{kind}").is_file()), None
    )
    return make_take(
        name=name,
        split=split,
        cameras=cameras,
        training=[camera for camera in cameras if camera not in heldout],
        heldout=[camera for camera in cameras if camera in heldout],
        views=views,
        poses=read_poses(folder / "smpl_params.npz", body, fps, DEFAULT_FPS),
        folder=folder,
        calibration_files=[camera_path, path],
        pose_files=[folder / "smpl_params.npz"],
        scan=scan,
        scan_frame=scan_frame if scan else None,
        notes=missing.notes(),
    )


def read_cameras(path: Path) -> tuple[dict[str, Camera], frozenset[str]]:
    """Cameras of a `cameras.json` in its order, and the names of those held out.

    Raises:
        MissingInput: no such file.
        BadData: entries missing or of the wrong shape, NaN, matrices that are no rotation.
    """
    content = read_json_object(path, "a calibration")
    refuse_unknown(content, ("cameras", "about"), str(path), "The calibration")
    entries = content.get("cameras")
    if not isinstance(entries, list) or not entries:
        raise BadData("cameras.json lists no cameras.", str(path), "Add an entry to cameras.")
    cameras: dict[str, Camera] = {}
    heldout = set()
    for number, entry in enumerate(entries):
        where = f"{path}: camera {number}"
        if (
            not isinstance(entry, dict)
            or not isinstance(entry.get("name"), str)
            or not NAME.fullmatch(entry["name"])
        ):
            raise BadData(
                "A camera has no usable name.", where, "Use letters, digits, dot, dash, underscore."
            )
        name = entry["name"]
        if name in cameras:
            raise BadData(f"Two cameras are called {name}.", where, "Give every camera a name of its own.")
        lacking = [key for key in ("width", "height", "intrinsics", "camera_from_world") if key not in entry]
        if lacking:
            raise BadData(f"Camera {name} lacks {lacking[0]}.", where, "Write the whole calibration.")
        refuse_unknown(entry, _CAMERA_FIELDS, where, f"Camera {name}")
        cameras[name] = checked_camera(
            name, entry["width"], entry["height"], entry["intrinsics"], entry["camera_from_world"], where
        )
        if truth_value(entry, "held_out", where):
            heldout.add(name)
    return cameras, frozenset(heldout)
