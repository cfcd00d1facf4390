"""COLMAP's sparse models, text and binary: `cameras.*` and `images.*`."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from stages.shared.calibration.model import Calibration, LensCamera, lens_camera, pose_from
from stages.shared.errors import BadData
from stages.shared.input_files import read_input, read_text
from stages.shared.quaternions import matrices_from_quaternions

# Name, and what its parameters are, by COLMAP's number of the model.
_MODELS: tuple[tuple[str, str], ...] = (
    ("SIMPLE_PINHOLE", "f cx cy"),
    ("PINHOLE", "fx fy cx cy"),
    ("SIMPLE_RADIAL", "f cx cy k1"),
    ("RADIAL", "f cx cy k1 k2"),
    ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    ("FOV", "fx fy cx cy omega"),
    ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
)
_NOT_KNOWN = ("FOV", "THIN_PRISM_FISHEYE")
_SAME_PLACE = 0.02  # of the rig's size: how far the images of one fixed camera may be apart
_Lens = tuple[str, tuple[int, int], list[float]]
_Image = tuple[str, int, list[float], list[float]]  # name, camera, quaternion wxyz, translation


def is_colmap(folder: Path) -> bool:
    """Whether a folder holds a sparse model."""
    return any(
        (folder / f"cameras.{kind}").is_file() and (folder / f"images.{kind}").is_file()
        for kind in ("bin", "txt")
    )


def read_colmap(folder: Path) -> Calibration:
    """The cameras of a sparse model; every folder of images, or every image, is one camera.

    Raises:
        BadData: cut short, a camera model that is not known, a camera that moves.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    suffix = "bin" if binary else "txt"
    files = (folder / f"cameras.{suffix}", folder / f"images.{suffix}")
    try:
        lenses = _binary_lenses(files[0]) if binary else _text_lenses(files[0])
        images = list(_binary_images(files[1]) if binary else _text_images(files[1]))
    except (struct.error, ValueError, IndexError) as error:
        raise BadData(
            f"The sparse model is damaged ({error}).", str(folder), "Export it again from COLMAP."
        ) from error
    if not images:
        raise BadData("The sparse model has no images.", str(files[1]), "Export it again from COLMAP.")
    cameras: dict[str, list[LensCamera]] = {}
    for image, number, quaternion, translation in sorted(images):
        if number not in lenses:
            raise BadData(
                f"Image {image} is of camera {number}, which is not listed.",
                str(files[1]),
                "Export again from COLMAP.",
            )
        camera = _camera(_camera_name(image, images), lenses[number], quaternion, translation, str(files[0]))
        cameras.setdefault(camera.name, []).append(camera)
    fixed = {name: _fixed(views, cameras, str(files[1])) for name, views in cameras.items()}
    return Calibration(fixed, f"COLMAP, {'binary' if binary else 'text'}", tuple(map(str, files)))


def _camera(
    name: str, lens: _Lens, quaternion: list[float], translation: list[float], where: str
) -> LensCamera:
    model, size, values = lens
    names = dict(_MODELS)[model].split()
    if model in _NOT_KNOWN:
        raise BadData(
            f"The camera model {model} cannot be undistorted here.",
            where,
            "Use OPENCV or OPENCV_FISHEYE, or export undistorted images from COLMAP.",
        )
    if len(names) != len(values):
        raise ValueError(f"{model} with {len(values)} parameters")
    value = dict(zip(names, values, strict=True))
    fx, fy = value.get("fx", value.get("f", 0.0)), value.get("fy", value.get("f", 0.0))
    fisheye = "FISHEYE" in model
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = [value.get(key, 0.0) for key in order[: 4 if "k3" not in value else 8]]
    intrinsics: list[list[float]] = [[fx, 0, value["cx"]], [0, fy, value["cy"]], [0, 0, 1]]
    unit = torch.tensor(quaternion, dtype=torch.float64)
    rotation = matrices_from_quaternions(unit / unit.norm()).numpy()
    pose = pose_from(rotation, translation)
    return lens_camera(
        name, size, intrinsics, pose, where, distortion, fisheye=fisheye, centres_at_integers=False
    )


def _camera_name(image: str, images: list[_Image]) -> str:
    """Folder of the image where images lie in folders, else the image's name without suffix."""
    path = PurePosixPath(image.replace("\\", "/"))
    in_folders = all("/" in other.replace("\\", "/") for other, *_ in images)
    return path.parent.name if in_folders else path.stem


def _fixed(views: list[LensCamera], cameras: dict[str, list[LensCamera]], where: str) -> LensCamera:
    """The one camera that all images of a folder were taken with: the median of their centres and the pose
    that is nearest to it."""
    if len(views) == 1:
        return views[0]
    centres = np.stack([view.centre for view in views])
    everything = np.concatenate([[view.centre for view in other] for other in cameras.values()])
    size = max(float(np.linalg.norm(np.ptp(everything, axis=0))), 1e-12)
    middle = np.median(centres, axis=0)
    away = np.linalg.norm(centres - middle, axis=1)
    if np.median(away) > _SAME_PLACE * size:
        raise BadData(
            f"Camera {views[0].name} moves between its images; gw needs fixed cameras.",
            where,
            "Give images of fixed cameras, one folder a camera.",
        )
    return replace(views[int(away.argmin())])


def _text_lenses(path: Path) -> dict[int, _Lens]:
    lenses = {}
    for line in _lines(path):
        number, model, width, height, *values = line.split()
        if model not in dict(_MODELS):
            raise ValueError(f"camera model {model}")
        lenses[int(number)] = (model, (int(width), int(height)), [float(value) for value in values])
    return lenses


def _text_images(path: Path) -> Iterator[_Image]:
    """Every image has two lines; the second, its points, may be empty."""
    lines = [
        line for line in read_text(path, "COLMAP's images").splitlines() if not line.lstrip().startswith("#")
    ]
    while lines and not lines[0].strip():
        lines.pop(0)
    for line in lines[::2]:
        if line.strip():
            _, qw, qx, qy, qz, tx, ty, tz, camera, name = line.split(maxsplit=9)
            yield (
                name.strip(),
                int(camera),
                [float(q) for q in (qw, qx, qy, qz)],
                [float(tx), float(ty), float(tz)],
            )


def _lines(path: Path) -> list[str]:
    text = read_text(path, "COLMAP's cameras")
    return [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def _binary_lenses(path: Path) -> dict[int, _Lens]:
    data = read_input(path, "COLMAP's cameras")
    (count,), at, lenses = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if not 0 <= model < len(_MODELS):
            raise ValueError(f"camera model number {model}")
        name, parameters = _MODELS[model]
        values = list(struct.unpack_from(f"<{len(parameters.split())}d", data, at + 24))
        at += 24 + 8 * len(values)
        lenses[number] = (name, (width, height), values)
    return lenses


def _binary_images(path: Path) -> Iterator[_Image]:
    data = read_input(path, "COLMAP's images")
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        values = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8", "replace")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        if at > len(data):
            raise ValueError("images.bin ends early")
        yield name, values[8], list(values[1:5]), list(values[5:8])
