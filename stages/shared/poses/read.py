"""One reader for every kind of pose file."""

from __future__ import annotations

from pathlib import Path

from stages.shared.body.easymocap import is_easymocap, read_easymocap
from stages.shared.body.model import BodyModel
from stages.shared.body.npz import NumericNpz
from stages.shared.body.poses import Poses, is_smpl_params, read_smpl_params
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.poses.amass import read_pose_vectors
from stages.shared.poses.bvh import read_bvh
from stages.shared.poses.convert import UPS, y_up_from_z_up
from stages.shared.poses.resample import resample

MAX_FILE_BYTES = 1 << 30


def load_poses(
    path: Path, body: BodyModel | None = None, fps: float | None = None, up: str = "auto"
) -> Poses:
    """Read a pose file: `smpl_params.npz`, EasyMocap's, AMASS SMPL-H (156 values) or SMPL-X (165), BVH.

    `smpl_params.npz` is also what Animatable Gaussians, ActorsHQ and THuman4 fits are distributed as.

    Arguments:
        path: the file; what it is is found out from its content, not from its name.
        body: model that the poses are for. Needed for BVH (rest pose and leg length), for 12-value hands, and
            for the exact place of z-up motion (the pelvis of the mean body is used without one).
        fps: resample to this frame rate; None keeps the file's own.
        up: axis of the file's world that points up: "y", "z", or "auto": z for AMASS, y for
            `smpl_params.npz`; BVH shows it by itself.

    Returns:
        Poses in the world of `gw`: metres, y up. Betas are the file's where they are of the 10-value
        convention (`smpl_params.npz`), else zero.

    Raises:
        MissingInput: no such file.
        BadData: unknown layout, wrong columns, NaN, missing arrays, too large, no frames.
        UsageProblem: another `up`, or one for a BVH file.
    """
    if up not in UPS:
        raise UsageProblem(f"No axis called {up!r} points up.", "option --up", "Choose auto, y or z.")
    path = Path(path)
    if not path.is_file():
        raise MissingInput("There is no pose file.", str(path), "Check the path.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise BadData("The pose file is larger than 1 GiB.", str(path), "Cut the motion into shorter files.")
    with path.open("rb") as stream:
        opening = stream.read(64).lstrip()
    if opening[:9].upper() == b"HIERARCHY":
        if up != "auto":
            raise UsageProblem(
                "Which axis of a BVH file points up is found from its motion.", str(path), "Leave --up out."
            )
        poses = read_bvh(path, body)
    else:
        with NumericNpz(path, "a pose file", limit=MAX_FILE_BYTES) as file:
            if is_easymocap(file.names):
                poses = read_easymocap(file, body)
                poses = y_up_from_z_up(poses, body) if up == "z" else poses
            elif is_smpl_params(file.names):
                poses = read_smpl_params(file, body)
                poses = y_up_from_z_up(poses, body) if up == "z" else poses
            else:
                poses = read_pose_vectors(file, body, z_up=up != "y")
    return poses if fps is None else resample(poses, fps)
