"""Readers for the layouts of Animatable Gaussians: THuman4 style and AvatarReX style.

THuman4: `images/<cam>/<frame>.jpg`, `masks/<cam>/<frame>.jpg`, `calibration.json`.
AvatarReX: `<cam>/<frame>.jpg`, `<cam>/mask/pha/<frame>.jpg`, `calibration_full.json`.
Both: camera name to {K: 9 numbers, R: 9, T: 3, imgSize: [w, h]}, world to camera, OpenCV axes;
`smpl_params.npz`; `missing_img_files.txt`. Labels (`labels/<cam>/<frame>.png`, `<cam>/labels/<frame>.png`)
and `scan.ply` of the first frame are additions, and optional.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from stages.shared.body.model import BodyModel
from stages.shared.capture.calibration import checked_camera, numbers, refuse_unknown
from stages.shared.capture.camera import Camera
from stages.shared.capture.gather import make_take, read_poses
from stages.shared.capture.take import Capture
from stages.shared.capture.view_files import CameraViews, MissingList, numbered_files
from stages.shared.errors import BadData
from stages.shared.input_files import read_json_object

USUAL_FPS: Final = 30.0
_PICTURE: Final = re.compile(r"(\d+)\.(?:jpg|jpeg|png)", re.IGNORECASE)
_LABELS: Final = re.compile(r"(\d+)\.png", re.IGNORECASE)
_NAME: Final = re.compile(r"[\w.-]{1,64}")


@dataclass(frozen=True)
class Layout:
    """Where a layout keeps its files; `{}` is the name of the camera."""

    name: str
    calibration: str
    images: str
    masks: str
    labels: str

    def fits(self, root: Path) -> bool:
        """Whether `root` has this layout."""
        return (root / self.calibration).is_file()

    def open(self, root: Path, body: BodyModel | None, body_model_path: Path | None) -> Capture:
        """The one take of the layout, for training."""
        calibration = root / self.calibration
        cameras = read_calibration_json(calibration)
        missing = MissingList.read(root)
        views = {
            name: CameraViews(
                numbered_files(root / self.images.format(name), _PICTURE),
                numbered_files(root / self.masks.format(name), _PICTURE),
                numbered_files(root / self.labels.format(name), _LABELS),
                missing,
            )
            for name in cameras
        }
        pose_path = root / "smpl_params.npz"
        poses = read_poses(pose_path, body, None, USUAL_FPS)
        scan = root / "scan.ply" if (root / "scan.ply").is_file() else None
        first = min((frame for seen in views.values() for frame in seen), default=0)
        take = make_take(
            name=root.resolve().name,
            split="train",
            cameras=cameras,
            training=cameras,
            heldout=(),
            views=views,
            poses=poses,
            folder=root,
            calibration_files=[calibration],
            pose_files=[pose_path],
            scan=scan,
            scan_frame=first if scan else None,
            notes=["this layout knows no test motion and no held-out camera.", *missing.notes()],
        )
        return Capture(root, self.name, (take,), body_model_path)


THUMAN4: Final = Layout("thuman4", "calibration.json", "images/{}", "masks/{}", "labels/{}")
AVATARREX: Final = Layout("avatarrex", "calibration_full.json", "{}", "{}/mask/pha", "{}/labels")


def read_calibration_json(path: Path) -> dict[str, Camera]:
    """Cameras of a `calibration.json`.

    Raises:
        BadData: no cameras, unusable names, missing or wrong numbers.
    """
    cameras = {}
    for name, entry in read_json_object(path, "a calibration").items():
        where = f"{path}: {name}"
        if not _NAME.fullmatch(name) or set(name) == {"."}:
            raise BadData(
                f"The camera name {name!r} is unusable.", where, "Use letters, digits, dash, underscore."
            )
        if not isinstance(entry, dict):
            raise BadData(f"Camera {name} is no JSON object.", where, "Write K, R, T and imgSize.")
        refuse_unknown(entry, ("K", "R", "T", "imgSize"), where, f"Camera {name}")
        width, height = _numbers(entry, "imgSize", 2, where)
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = _numbers(entry, "R", 9, where).reshape(3, 3)
        camera_from_world[:3, 3] = _numbers(entry, "T", 3, where)
        intrinsics = _numbers(entry, "K", 9, where).reshape(3, 3)
        cameras[name] = checked_camera(name, width, height, intrinsics, camera_from_world, where)
    if not cameras:
        raise BadData("The calibration lists no camera.", str(path), "Copy the file again.")
    return cameras


def _numbers(entry: dict[str, Any], key: str, count: int, where: str) -> np.ndarray:
    array = numbers(entry.get(key))
    if array is None:
        raise BadData(f"{key} is missing or holds no numbers.", where, f"Write {count} numbers.")
    values = array.reshape(-1)
    if len(values) != count or not np.isfinite(values).all():
        raise BadData(f"{key} is not {count} finite numbers.", where, f"Write {count} numbers.")
    return values
