"""One reader for every kind of pose file."""

from __future__ import annotations

from pathlib import Path

from stages.shared.body.canonical import canonical_poses
from stages.shared.body.model import BodyModel
from stages.shared.body.npz import NumericNpz
from stages.shared.body.poses import Poses
from stages.shared.errors import BadData, UsageProblem
from stages.shared.finite import require_finite
from stages.shared.input_files import CANONICAL, check_input_file, decode_text
from stages.shared.poses.bvh import read_bvh
from stages.shared.poses.convert import UPS, check_length, resample, y_up
from stages.shared.poses.npz_layouts import read_pose_arrays
from stages.shared.poses.plausibility import motion_warnings
from stages.shared.poses.pose_arrays import PoseUnits
from stages.shared.report import SILENT, Report

MAX_FILE_BYTES = 1 << 30


def load_poses(
    path: Path,
    body: BodyModel | None = None,
    fps: float | None = None,
    up: str = "auto",
    units: PoseUnits = PoseUnits(),
    one_person: bool = False,
    report: Report = SILENT,
) -> Poses:
    """Read a pose file: the `.npz` layouts of SMPL, SMPL-H and SMPL-X programs, or BVH.

    Arguments:
        path: the file, whose content decides what it is, not its name; or `canonical`: one frame in the
            canonical pose.
        body: model that the poses are for. Needed for BVH (rest pose and leg length), for hands as
            coefficients, and for the exact place of a motion with another up axis (a mean pelvis is used
            without one).
        fps: resample to this frame rate; None keeps the file's own.
        up: axis of the file's world that points up, one of `UPS`; "auto" is z for AMASS, y for the other
            `.npz` layouts, and the one of the rest pose for BVH.
        units: what the file does not state about itself.
        one_person: the file is a fit of one person, so translation and one shape are required.
        report: is warned of what was assumed, and of a motion that is not plausible. Without it nothing of
            that is looked at.

    Returns:
        Poses in the world of `gw`: metres, y up. Betas are the file's where they are of the 10-value
        convention (not those of AMASS), else zero.

    Raises:
        MissingInput: no such file.
        BadData: unknown layout, other shapes, values that are not finite, too large, no frames.
        UsageProblem: an `up` that is not one of `UPS`; units for a BVH file, which has its own.
    """
    if up not in UPS:
        raise UsageProblem(
            f"No axis called {up!r} points up.", "option --up", "Choose one of: " + ", ".join(UPS) + "."
        )
    path = Path(path)
    if str(path) == CANONICAL:
        return canonical_poses()
    check_input_file(path, "a pose file", MAX_FILE_BYTES)

    def note(text: str) -> None:
        report.warn(f"{path.name}: {text}")

    if _is_bvh(path):
        if units.degrees or units.metres != 1.0:
            raise UsageProblem(
                "Angles of BVH are degrees, and its lengths are scaled by the legs.",
                str(path),
                "Leave --degrees and --length-unit out.",
            )
        poses, axis = read_bvh(path, body, up, note, units.fps)
    elif not _is_archive(path):
        raise BadData(
            "This is not a pose file of a known kind: neither BVH nor an .npz archive.",
            str(path),
            "Give a smpl_params.npz, an AMASS or EasyMocap .npz, or a BVH file.",
        )
    else:
        with NumericNpz(path, "a pose file", limit=MAX_FILE_BYTES) as file:
            poses, axis = read_pose_arrays(file, body, note, one_person, units)
        axis = axis if up == "auto" else up
        poses = y_up(poses, axis, body)
    try:
        require_finite("load_poses", rotations=poses.rotations, translation=poses.translation)
        require_finite("load_poses", betas=poses.betas, expression=poses.expression)
    except BadData as error:
        raise BadData(
            "The motion is beyond what 32 bits can hold.",
            f"{path}: {error.where}",
            "Export the motion again.",
        ) from error
    if report is not SILENT:
        for warning in motion_warnings(poses, axis, body):
            note(warning)
    if fps is None:
        return poses
    check_length(poses, fps, str(path))
    return resample(poses, fps)


def _is_bvh(path: Path) -> bool:
    with path.open("rb") as stream:
        opening = decode_text(stream.read(4096), errors="replace")
    return opening.lstrip()[:9].upper() == "HIERARCHY"


def _is_archive(path: Path) -> bool:
    """Whether the file begins like a zip archive, or like a pickle, which has an explanation of its own."""
    with path.open("rb") as stream:
        return stream.read(4)[:2] in (b"PK", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")
