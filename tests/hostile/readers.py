"""Every reader of files from outside, with a good file to begin from."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from stages.shared.artifacts.arrays import encode_arrays
from stages.shared.artifacts.bundle import Bundle, encode_bundle, read_bundle
from stages.shared.artifacts.canonical import digest
from stages.shared.artifacts.manifest import Manifest, read_manifest
from stages.shared.artifacts.pictures import encode_png
from stages.shared.body.poses import npz_bytes
from stages.shared.capture.actorshq import read_calibration
from stages.shared.capture.images import read_image, read_mask
from stages.shared.capture.labels import read_labels
from stages.shared.capture.native import read_cameras
from stages.shared.meshes.load import load_mesh
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.ply import encode_ply
from stages.shared.poses.bvh_file import read_bvh_file
from stages.shared.poses.read import load_poses

GOLDEN = Path(__file__).parents[1] / "golden"


@dataclass(frozen=True)
class Reader:
    """A reader, and what is fuzzed.

    Attributes:
        file: name of the file it is given. good: what the fuzzing begins from. read: how it is called.
        file_of: the file that comes of what was fuzzed; as it is, unless said otherwise.
    """

    file: str
    good: Callable[[], bytes]
    read: Callable[[Path], object]
    file_of: Callable[[bytes], bytes] = bytes


def _bundle() -> bytes:
    return b"".join(bytes(chunk) for chunk in encode_bundle(_small_bundle()))


@cache
def _small_bundle() -> Bundle:
    return read_bundle(GOLDEN / "garment-f16-1.1.gwg")


def _bundle_manifest() -> bytes:
    """The sealed manifest inside a bundle: text that only the check of its meaning can refuse."""
    notes = json.loads(_header(_bundle()))["__metadata__"]
    return str(notes["gwg"]).encode()


def _sealed(manifest: bytes) -> bytes:
    """A bundle with this manifest and the digest that belongs to it."""
    text = manifest.decode("utf-8", "replace")
    notes = {"gwg": text, "gwg_sha256": digest(text.encode())}
    return b"".join(bytes(chunk) for chunk in encode_arrays(_small_bundle().arrays, "sealed", notes))


def _header(content: bytes) -> bytes:
    (length,) = struct.unpack_from("<Q", content)
    return content[8 : 8 + length]


def _manifest() -> bytes:
    return Manifest("bake-maps", "1.0", 1, {"pitch": 0.01}, summary={"layers": ["body"]}).to_bytes()


def _mesh(text: bool = False) -> bytes:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], np.int32)
    if text:
        rows = [f"v {x} {y} {z}" for x, y, z in vertices] + [
            f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces
        ]
        return "\n".join(rows).encode()
    return b"".join(bytes(chunk) for chunk in encode_ply(Mesh(vertices, faces, np.full((4, 3), 9, np.uint8))))


def _poses() -> bytes:
    arrays = {"poses": np.zeros((2, 165), np.float32), "trans": np.zeros((2, 3), np.float32)}
    return npz_bytes({**arrays, "mocap_frame_rate": np.array(30.0)})


def _bvh() -> bytes:
    return (
        b"HIERARCHY\nROOT Hips\n{\n OFFSET 0 0 0\n CHANNELS 6 Xposition Yposition Zposition "
        b"Zrotation Xrotation Yrotation\n JOINT Spine\n {\n  OFFSET 0 10 0\n"
        b"  CHANNELS 3 Zrotation Xrotation Yrotation\n  End Site\n"
        b"  {\n   OFFSET 0 5 0\n  }\n }\n}\nMOTION\nFrames: 2\nFrame Time: 0.033\n"
        b"0 90 0 0 0 0 1 2 3\n0 90 0 0 5 0 4 5 6\n"
    )


def _cameras() -> bytes:
    camera = {
        "name": "cam0",
        "width": 8,
        "height": 6,
        "intrinsics": [[5, 0, 4], [0, 5, 3], [0, 0, 1]],
        "camera_from_world": np.eye(4).tolist(),
    }
    return json.dumps({"cameras": [camera]}).encode()


def _calibration() -> bytes:
    return b"name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py\nCam001,8,6,0.1,0.2,0.3,1,2,3,1.1,1.1,0.5,0.5\n"


def _picture() -> bytes:
    return bytes(encode_png(np.arange(8 * 6 * 3, dtype=np.uint8).reshape(6, 8, 3)))


def _mask() -> bytes:
    return bytes(encode_png(np.full((6, 8), 255, np.uint8)))


def _manifest_folder(path: Path) -> object:
    return read_manifest(path.parent)


READERS = {
    "bundle": Reader("skirt.gwg", _bundle, read_bundle),
    "bundle-manifest": Reader("skirt.gwg", _bundle_manifest, read_bundle, _sealed),
    "manifest": Reader("manifest.json", _manifest, _manifest_folder),
    "ply": Reader("scan.ply", _mesh, load_mesh),
    "obj": Reader("scan.obj", lambda: _mesh(text=True), load_mesh),
    "poses": Reader("motion.npz", _poses, load_poses),
    "bvh": Reader("motion.bvh", _bvh, read_bvh_file),
    "cameras": Reader("cameras.json", _cameras, read_cameras),
    "calibration": Reader("calibration.csv", _calibration, read_calibration),
    "image": Reader("image.png", _picture, read_image),
    "mask": Reader("mask.png", _mask, read_mask),
    "labels": Reader("labels.png", _mask, read_labels),
}
