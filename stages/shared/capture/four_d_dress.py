"""Reader for the 4D-DRESS layout: `<subject>/<Inner|Outer>/TakeN/{Capture, SMPLX, Meshes_pkl, Semantic}`.

Frames are numbered from 0 in the order of the fits; files keep their five-digit names. Every number in this
data set is in a pickle; all of them go through the quarantined child process.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from stages.shared.body.model import BodyModel
from stages.shared.body.npz import NumericNpz
from stages.shared.body.poses import Poses
from stages.shared.capture.calibration import checked_camera, refuse_unknown
from stages.shared.capture.camera import Camera
from stages.shared.capture.gather import make_take
from stages.shared.capture.image_files import check_picture
from stages.shared.capture.images import read_bytes
from stages.shared.capture.pickles import PickleReader, array_of, dictionary
from stages.shared.capture.take import Capture, Split, Take
from stages.shared.capture.view_files import CameraViews, numbered_files
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.poses.npz_layouts import read_pose_arrays

FORMAT: Final = "4d-dress"
FPS: Final = 30.0
_HAND_COEFFICIENTS: Final = 12
_OPTIONAL = ("jaw_pose", "leye_pose", "reye_pose", "left_hand_pose", "right_hand_pose", "expression")
# Test takes of the outfits that published avatars were judged on; elsewhere the last take is for testing.
_TEST_TAKES: Final[dict[tuple[str, str], tuple[int, ...]]] = {
    ("00185", "Inner"): (7, 8), ("00185", "Outer"): (18, 19, 20), ("00127", "Inner"): (9, 10),
    ("00127", "Outer"): (18, 19), ("00134", "Inner"): (9, 10), ("00134", "Outer"): (20, 22),
    ("00148", "Inner"): (9, 10), ("00156", "Inner"): (8, 9), ("00156", "Outer"): (19, 20),
    ("00151", "Inner"): (9,), ("00129", "Inner"): (21, 22), ("00170", "Inner"): (11, 12),
    ("00140", "Inner"): (10, 11), ("00163", "Inner"): (9, 10), ("00163", "Outer"): (18, 19),
    ("00187", "Inner"): (8, 9), ("00160", "Inner"): (9, 10), ("00188", "Inner"): (8, 9),
}  # fmt: skip


def take_folders(root: Path) -> list[Path]:
    """The take at `root`, or the takes in `root` or up to two folders below it; empty for other layouts.

    Raises:
        UsageProblem: takes in several folders (a subject with two outfits, a folder with two subjects).
    """
    if _is_take(root):
        return [root]
    for pattern in ("Take*", "*/Take*", "*/*/Take*"):
        takes = [folder for folder in root.glob(pattern) if _is_take(folder)]
        parents = sorted({folder.parent for folder in takes})
        if len(parents) > 1:
            raise UsageProblem(
                f"{len(parents)} folders here have takes: one outfit of one person at a time.",
                str(root),
                "Give one of: " + ", ".join(str(parent) for parent in parents[:4]) + ".",
            )
        if takes:
            return sorted(takes, key=_take_number)
    return []


def _is_take(folder: Path) -> bool:
    return (folder / "Capture" / "cameras.pkl").is_file()


def open_4d_dress(root: Path, body: BodyModel | None, body_model_path: Path | None) -> Capture:
    """All takes of one outfit, or the take at `root`."""
    folders = take_folders(root)
    if not folders:
        raise MissingInput(
            "There is no 4D-DRESS take here.",
            f"{root}: no Take*/Capture/cameras.pkl",
            "Give the folder Inner or Outer.",
        )
    with PickleReader() as pickles:
        takes = tuple(_read_take(folder, _split(folder, folders), pickles, body) for folder in folders)
    return Capture(root, FORMAT, takes, body_model_path)


def _read_take(folder: Path, split: Split, pickles: PickleReader, body: BodyModel | None) -> Take:
    fits = numbered_files(folder / "SMPLX", re.compile(r"mesh-f(\d+)_smplx\.pkl"))
    order = sorted(fits) or _frames_with_images(folder)
    row = {number: place for place, number in enumerate(order)}
    notes: list[str] = []
    poses: Poses | float = FPS
    if fits:
        given = [dictionary(pickles.read(fits[number]), fits[number]) for number in order]
        poses = _poses(given, folder / "SMPLX", body, notes)
    camera_path = folder / "Capture" / "cameras.pkl"
    calibration = dictionary(pickles.read(camera_path), camera_path)
    cameras, views = {}, {}
    for name, entry in calibration.items():
        place = folder / "Capture" / name
        if not re.fullmatch(r"[\w-]{1,64}", name):
            raise BadData(f"The camera name {name!r} is unusable.", str(camera_path), "Get the file again.")
        images = numbered_files(place / "images", re.compile(r"capture-f(\d+)\.png"))
        if not images:
            notes.append(f"camera {name} is calibrated, but its images are not there.")
            continue
        masks = numbered_files(place / "masks", re.compile(r"mask-f(\d+)\.png"))
        labels = numbered_files(place / "labels", re.compile(r"label-f(\d+)\.png"))
        cameras[name] = _camera(name, entry, images[min(images)], camera_path)
        views[name] = CameraViews(images.renumbered(row), masks.renumbered(row), labels.renumbered(row))
    meshes = numbered_files(folder / "Meshes_pkl", re.compile(r"mesh-f(\d+)\.pkl"))
    scanned = [number for number in order if number in meshes]
    return make_take(
        name=folder.resolve().name,
        split=split,
        cameras=cameras,
        training=cameras,
        heldout=(),
        views=views,
        poses=poses,
        folder=folder,
        calibration_files=[camera_path],
        pose_files=list(fits.values()),
        scan=meshes[scanned[0]] if scanned else None,
        scan_frame=row[scanned[0]] if scanned else None,
        scans={row[number]: meshes[number] for number in scanned},
        notes=notes,
    )


def _frames_with_images(folder: Path) -> list[int]:
    """Frame numbers of a take without fits."""
    pattern = re.compile(r"capture-f(\d+)\.png")
    found: set[int] = set()
    for images in sorted((folder / "Capture").glob("*/images")):
        found |= set(numbered_files(images, pattern))
    return sorted(found)


def _camera(name: str, entry: Any, image: Path, path: Path) -> Camera:
    where = f"{path}: camera {name}"
    if not isinstance(entry, dict) or not {"intrinsics", "extrinsics"} <= set(entry):
        raise BadData(f"Camera {name} lacks intrinsics or extrinsics.", where, "Get the file again.")
    refuse_unknown(entry, ("intrinsics", "extrinsics"), where, f"Camera {name}")
    width, height = check_picture(read_bytes(image), image)
    return checked_camera(name, width, height, entry["intrinsics"], entry["extrinsics"], where)


def _poses(frames: list[dict[str, Any]], folder: Path, body: BodyModel | None, notes: list[str]) -> Poses:
    """The fits of all frames, stacked as a `smpl_params.npz` has them.

    Hands are 12 coefficients of the body model's hand space around its mean hand. A model without such a
    space leaves the hands flat, which is noted.
    """
    arrays: dict[str, np.ndarray] = {}
    for name in ("global_orient", "transl", "body_pose", *_OPTIONAL):
        if name in _OPTIONAL and name not in frames[0]:
            continue
        rows = [array_of(frame, name, folder).reshape(-1) for frame in frames]
        if len({len(values) for values in rows}) != 1:
            raise BadData(
                f"{name} has different lengths in different frames.", str(folder), "Get the files again."
            )
        arrays[name] = np.stack(rows)
    arrays["betas"] = array_of(frames[0], "betas", folder).reshape(1, -1)
    arrays["fps"] = np.array(FPS)
    if any(arrays[name].shape[1] == _HAND_COEFFICIENTS for name in arrays if name.endswith("_hand_pose")):
        if body is None or body.hand_components_left is None or body.hand_components_right is None:
            arrays.pop("left_hand_pose", None)
            arrays.pop("right_hand_pose", None)
            notes.append(
                "hands stay flat: they are given in the hand space of SMPL-X, which the body model lacks."
            )
        else:
            arrays["flat_hand_mean"] = np.array(False)
    stack = cast(NumericNpz, _Stack(folder, arrays))
    return read_pose_arrays(stack, body, notes.append, one_person=True)[0]


class _Stack:
    """Arrays in memory that read like an open `.npz`."""

    def __init__(self, path: Path, arrays: dict[str, np.ndarray]) -> None:
        self.path, self.arrays = path, arrays

    @property
    def names(self) -> frozenset[str]:
        return frozenset(self.arrays)

    def __contains__(self, name: str) -> bool:
        return name in self.arrays

    def shape(self, name: str) -> tuple[int, ...]:
        return self.arrays[name].shape

    def numbers(self, name: str) -> np.ndarray:
        return self.array(name).astype(np.float64)

    def array(self, name: str, finite: bool = True) -> np.ndarray:
        values = self.arrays[name]
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise BadData(f"{name} contains NaN or infinity.", str(self.path), "Get the files again.")
        return values


def _split(folder: Path, folders: list[Path]) -> Split:
    if len(folders) == 1:
        return "train"
    outfit = folder.resolve().parent
    known = _TEST_TAKES.get((outfit.parent.name, outfit.name))
    test = known if known is not None else (_take_number(folders[-1]),)
    return "test" if _take_number(folder) in test else "train"


def _take_number(folder: Path) -> int:
    digits = re.sub(r"\D", "", folder.name)[:9]
    return int(digits) if digits else 0
