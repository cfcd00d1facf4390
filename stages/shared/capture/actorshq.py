"""Reader for the ActorsHQ layout: `SequenceN/{1x,2x,4x}/{calibration.csv, rgbs, masks, smpl_params.npz}`.

`calibration.csv` holds camera-to-world axis-angle and position; focal length and principal point are divided
by the image size. Labels (`labels/CamNNN/label-fFFFFFF.png`), the entries `split`, `fps`, `train_cameras` and
`heldout_cameras` of `scene.json`, and scans (`gt/scan-fFFFFFF.ply` or beside) are additions, all optional.
"""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.body.model import BodyModel
from stages.shared.capture.calibration import checked_camera, positive_rate, refuse_unknown
from stages.shared.capture.camera import Camera
from stages.shared.capture.gather import make_take, read_poses
from stages.shared.capture.rotation import rotation_of_axis_angle
from stages.shared.capture.take import Capture, Split, Take
from stages.shared.capture.view_files import CameraViews, MissingList, NumberedFiles, numbered_files
from stages.shared.errors import BadData, MissingInput
from stages.shared.input_files import read_json_object, read_text

FORMAT = "actorshq"
ACTORSHQ_FPS = 25.0
_SCALES = ("4x", "2x", "1x")  # the smallest first: it is the one that published avatars were made from
_COLUMNS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
_MAX_TABLE_BYTES = 16 << 20
_LABEL_FOLDERS = ("labels", "labels_color")
_SCAN = re.compile(r"scan-f(\d+)\.(?:ply|obj)")
# The views that avatars of this data set were trained on and judged by, used when all 160 cameras are there.
_USUAL_TRAINING = tuple(f"Cam{i:03d}" for i in (7, 22, 39, 56, 79, 80, 95, 109, 112, 126, 127, 151, 152, 160))
_USUAL_HELDOUT = ("Cam128",)


def sequence_folders(root: Path) -> list[Path]:
    """Scale folders of the sequences at `root`: an actor, a sequence or a scale folder."""
    if (root / "calibration.csv").is_file():
        return [root]
    folders = [root, *sorted(root.glob("Sequence*"))]
    found = []
    for folder in folders:
        scale = next(
            (folder / scale for scale in _SCALES if (folder / scale / "calibration.csv").is_file()), None
        )
        if scale:
            found.append(scale)
    return found


def open_actorshq(root: Path, body: BodyModel | None, body_model_path: Path | None) -> Capture:
    """All sequences of an actor, or the one at `root`."""
    folders = sequence_folders(root)
    if not folders:
        raise MissingInput(
            "There is no ActorsHQ sequence here.",
            f"{root}: no 1x, 2x or 4x/calibration.csv",
            "Give an actor's folder.",
        )
    takes = tuple(_read_sequence(folder, place, len(folders), body) for place, folder in enumerate(folders))
    return Capture(root, FORMAT, takes, body_model_path)


def _read_sequence(folder: Path, place: int, count: int, body: BodyModel | None) -> Take:
    sequence = folder.parent
    scene_path = sequence / "scene.json"
    scene = read_json_object(scene_path, "a description of the sequence") if scene_path.is_file() else {}
    cameras = read_calibration(folder / "calibration.csv")
    missing = MissingList.read(folder)
    notes: list[str] = []
    seen = [name for name in cameras if _has_files(folder / "rgbs" / name)]
    training, heldout = _camera_split(scene, list(cameras), seen, scene_path, notes)
    views = {name: _views_of_camera(folder, name, missing) for name in (*training, *heldout)}
    notes += missing.notes()
    fps = positive_rate(scene, "fps", str(scene_path))
    pose_paths = (folder / "smpl_params.npz", sequence / "smpl_params.npz")
    pose_path = next((path for path in pose_paths if path.is_file()), pose_paths[0])
    scan, scan_frame = _scan(sequence)
    return make_take(
        name=sequence.name,
        split=_split(scene, place, count, scene_path),
        cameras=cameras,
        training=training,
        heldout=heldout,
        views=views,
        poses=read_poses(pose_path, body, fps, ACTORSHQ_FPS),
        folder=folder,
        calibration_files=[folder / "calibration.csv", *([scene_path] if scene else [])],
        pose_files=[pose_path],
        scan=scan,
        scan_frame=scan_frame,
        notes=notes,
    )


def read_calibration(path: Path) -> dict[str, Camera]:
    """Cameras of a `calibration.csv`, in its order.

    Raises:
        BadData: missing columns, text where numbers belong, NaN, no camera, a name twice.
    """
    text = read_text(path, "a calibration", _MAX_TABLE_BYTES)
    try:
        rows = list(csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True))
    except csv.Error as error:
        raise BadData(
            f"The calibration is not a CSV table: {error}.", str(path), "Copy the file again."
        ) from error
    if not rows:
        raise BadData("The calibration lists no camera.", str(path), "Copy the file again.")
    cameras: dict[str, Camera] = {}
    for number, row in enumerate(rows, start=2):
        row = {(key or "").strip(): value for key, value in row.items()}
        lacking = [column for column in _COLUMNS if not isinstance(row.get(column), str)]
        if lacking:
            raise BadData(
                f"The calibration lacks the column {lacking[0]}.",
                f"{path}, line {number}",
                "Copy the file again.",
            )
        refuse_unknown(
            {key: _csv_value(value) for key, value in row.items()},
            _COLUMNS,
            f"{path}, line {number}",
            "The row",
        )
        name = row["name"].strip()
        if name in cameras or not re.fullmatch(r"[\w.-]{1,64}", name):
            raise BadData(
                f"The camera name {name!r} is unusable or stands twice.",
                f"{path}, line {number}",
                "Give every camera a name of its own, of letters, digits, dot, dash, underscore.",
            )
        cameras[name] = _camera_of_row(name, row, f"{path}, line {number}")
    return cameras


def _camera_of_row(name: str, row: dict[str, Any], where: str) -> Camera:
    try:
        width, height = int(row["w"]), int(row["h"])
        value = {column: float(row[column]) for column in _COLUMNS[3:]}
    except ValueError as error:
        raise BadData(f"Camera {name}: {error}.", where, "Mend the calibration.") from error
    if not all(map(math.isfinite, value.values())):
        raise BadData(
            f"Camera {name}: the calibration contains NaN or infinity.", where, "Mend the calibration."
        )
    camera_from_world = np.eye(4)
    rotation = rotation_of_axis_angle(np.array([value["rx"], value["ry"], value["rz"]])).T
    camera_from_world[:3, :3] = rotation
    camera_from_world[:3, 3] = -rotation @ np.array([value["tx"], value["ty"], value["tz"]])
    intrinsics = np.array(
        [
            [value["fx"] * width, 0.0, value["px"] * width],
            [0.0, value["fy"] * height, value["py"] * height],
            [0.0, 0.0, 1.0],
        ]
    )
    return checked_camera(name, width, height, intrinsics, camera_from_world, where)


def _csv_value(value: Any) -> Any:
    """A number where the text is one; the text otherwise, and None for an empty cell."""
    try:
        return float(value) if value else None
    except (TypeError, ValueError):
        return value


def _has_files(folder: Path) -> bool:
    return folder.is_dir() and next(folder.iterdir(), None) is not None


def _views_of_camera(folder: Path, name: str, missing: MissingList) -> CameraViews:
    quoted = re.escape(name)
    images = numbered_files(folder / "rgbs" / name, re.compile(rf"{quoted}_rgb(\d+)\.(?:jpg|jpeg|png)", re.I))
    masks = numbered_files(folder / "masks" / name, re.compile(rf"{quoted}_mask(\d+)\.(?:png|jpg)", re.I))
    labels = NumberedFiles(folder, {})
    for label_folder in _LABEL_FOLDERS:
        labels = labels or numbered_files(
            folder / label_folder / name, re.compile(r"label-f(\d+)\.png", re.I)
        )
    return CameraViews(images, masks, labels, missing)


def _camera_split(
    scene: dict[str, Any], cameras: list[str], seen: list[str], scene_path: Path, notes: list[str]
) -> tuple[list[str], list[str]]:
    """Names of training and of held-out cameras, out of all names and those that have images."""
    given = {key: scene[key] for key in ("train_cameras", "heldout_cameras") if key in scene}
    for key, names in given.items():
        unknown = [name for name in names if name not in cameras] if isinstance(names, list) else [names]
        if unknown:
            raise BadData(
                f"{key} names a camera without calibration: {unknown[0]!r}.",
                str(scene_path),
                "Take it out of the list, or add its row to calibration.csv.",
            )
    listed = [name for names in given.values() for name in names]
    if len(set(listed)) < len(listed):
        twice = next(name for name in listed if listed.count(name) > 1)
        raise BadData(
            f"{twice} stands twice in train_cameras and heldout_cameras.",
            str(scene_path),
            "A camera is either for training or held out.",
        )
    if "train_cameras" in given:
        return list(given["train_cameras"]), list(given.get("heldout_cameras", []))
    if set(_USUAL_TRAINING) <= set(seen):
        notes.append(f"of {len(seen)} cameras the usual {len(_USUAL_TRAINING)} train and Cam128 is held out.")
        return list(_USUAL_TRAINING), [name for name in _USUAL_HELDOUT if name in seen]
    heldout = list(given.get("heldout_cameras", []))
    if len(seen) < len(cameras):
        notes.append(f"{len(cameras) - len(seen)} of {len(cameras)} calibrated cameras have no images.")
    return [name for name in seen if name not in heldout], heldout


def _split(scene: dict[str, Any], place: int, count: int, scene_path: Path) -> Split:
    split = scene.get("split")
    if split is None:
        return "train" if place == 0 or count == 1 else "test"
    if split not in ("train", "test"):
        raise BadData(f"split is {split!r}.", str(scene_path), 'Write "train" or "test".')
    return split


def _scan(sequence: Path) -> tuple[Path | None, int | None]:
    for folder in (sequence / "gt", sequence):
        scans = numbered_files(folder, _SCAN)
        if scans:
            frame = min(scans)
            return scans[frame], frame
    return None, None
