"""From the files of a take to the frames that can be used; shared by the readers of all layouts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.shared.body.model import BodyModel
from stages.shared.body.npz import NumericNpz
from stages.shared.body.poses import MAX_FRAMES, Poses
from stages.shared.body.skeleton import EXPRESSION_COUNT, JOINT_COUNT, SHAPE_COUNT
from stages.shared.capture.camera import Camera
from stages.shared.capture.take import Split, Take
from stages.shared.capture.view_files import CameraViews, TakeViews
from stages.shared.errors import BadData, MissingInput
from stages.shared.poses.npz_layouts import read_pose_arrays, stated_fps


def read_poses(path: Path, body: BodyModel | None, fps: float | None, usual_fps: float) -> Poses | float:
    """Poses of a `smpl_params.npz`, row = frame number; only the frame rate when there is no such file.

    The frame rate is `fps` when the capture states one, else what the file says, else `usual_fps`.

    Raises:
        BadData: as `read_smpl_params`.
    """
    if not path.is_file():
        return float(usual_fps if fps is None else fps)
    with NumericNpz(path, "a pose file") as file:
        poses, up = read_pose_arrays(file, body, lambda text: None, one_person=True)
        if up != "y":
            raise BadData(
                "These are pose vectors of AMASS; a capture's poses are in the world of its cameras.",
                str(path),
                "Store them as smpl_params.npz: gw poses FILE -o smpl_params.npz.",
            )
        stated = stated_fps(file) is not None
    if fps is None and stated:
        return poses
    return replace(poses, fps=float(usual_fps if fps is None else fps))


def make_take(
    name: str,
    split: Split,
    cameras: Mapping[str, Camera],
    training: Iterable[str],
    heldout: Iterable[str],
    views: Mapping[str, CameraViews],
    poses: Poses | float,
    folder: Path,
    calibration_files: Iterable[Path],
    pose_files: Iterable[Path],
    scan: Path | None = None,
    scan_frame: int | None = None,
    notes: Iterable[str] = (),
    scans: Mapping[int, Path] | None = None,
) -> Take:
    """A take whose frames are those that every training camera saw, with mask, and that have a pose.

    Arguments:
        poses: row = frame number; a frame rate alone when the capture brings no poses.

    Raises:
        MissingInput: a training camera without a single view; no frame left.
    """
    training, heldout = tuple(training), tuple(heldout)
    for camera in training:
        if not views.get(camera):
            raise MissingInput(
                f"Camera {camera} is calibrated, but has no images with masks.",
                f"{folder} ({name})",
                f"Copy the images of {camera}, or take it out of the calibration.",
            )
    if not training:
        raise MissingInput(
            "No camera has images.", f"{folder} ({name})", "Check the folder names of the cameras."
        )
    somewhere = set().union(*(views[camera] for camera in training))
    everywhere = set.intersection(*(set(views[camera]) for camera in training))
    posed = isinstance(poses, Poses)
    if not isinstance(poses, Poses):
        poses, pose_files = rest_poses(1 + max(somewhere), poses), ()
    frames = sorted(frame for frame in everywhere if frame < len(poses))
    remarks = list(notes)
    partly, poseless = len(somewhere - everywhere), len(everywhere) - len(frames)
    if partly:
        remarks.append(
            f"{partly} of {len(somewhere)} frames are left out: not every training camera has image and mask."
        )
    if poseless:
        remarks.append(f"{poseless} frames are left out: the pose file has only {len(poses)} rows.")
    if not frames:
        raise MissingInput(
            "No frame has image, mask and pose for every training camera.",
            f"{folder} ({name}: {len(somewhere)} frames with images, {len(poses)} poses)",
            "Check that frame numbers of images, masks and poses agree.",
        )
    if not any(views[camera].labelled for camera in training):
        remarks.append("there are no label images.")
    return Take(
        name=name,
        split=split,
        cameras=dict(cameras),
        training_cameras=training,
        heldout_cameras=heldout,
        frames=frames,
        poses=poses,
        views=TakeViews({camera: views[camera] for camera in cameras if camera in views}),
        calibration_files=tuple(calibration_files),
        pose_files=tuple(pose_files),
        scan=scan,
        scan_frame=scan_frame,
        notes=tuple(remarks),
        posed=posed,
        scans={frame: path for frame, path in (scans or {}).items() if frame in frames},
    )


def rest_poses(frames: int, fps: float) -> Poses:
    """As many rest poses: what stands in a take that has none yet."""
    if frames > MAX_FRAMES:
        raise BadData(f"Frame numbers go up to {frames}.", "the take's images", "Number the frames from 0.")
    return Poses(
        np.zeros((frames, JOINT_COUNT, 3), np.float32),
        np.zeros((frames, 3), np.float32),
        np.zeros(SHAPE_COUNT, np.float32),
        np.zeros((frames, EXPRESSION_COUNT), np.float32),
        fps,
    )
