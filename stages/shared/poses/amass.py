"""Pose vectors in the AMASS layouts: SMPL-H with 156 values a frame, SMPL-X with 165, z up."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.body.model import BodyModel
from stages.shared.body.npz import NumericNpz
from stages.shared.body.poses import DEFAULT_FPS, MAX_FRAMES, Poses, positive_fps
from stages.shared.body.skeleton import (
    BODY,
    EXPRESSION_COUNT,
    JOINT_COUNT,
    LEFT_HAND,
    RIGHT_HAND,
    SHAPE_COUNT,
)
from stages.shared.errors import BadData

_SMPLH_VALUES, _SMPLX_VALUES, _SMPL_VALUES = 156, 165, 72

# y up from z up: −90° about x.
Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def read_pose_vectors(file: NumericNpz, body: BodyModel | None = None, z_up: bool = True) -> Poses:
    """Poses out of an open AMASS file (`*_poses.npz`, `*_stageii.npz`, or anything with the same two arrays).

    Keys: poses (T,156), (T,165) or (T,72), trans (T,3); optional mocap_framerate, mocap_frame_rate or fps.
    The motion is turned from z up to y up, unless the file's world has y up already (`z_up` False). Its betas
    are of another, gendered shape space and are left out.

    Raises:
        BadData: other columns, NaN, missing arrays, no frames.
    """
    vectors = file.array("poses").astype(np.float64)
    if vectors.ndim != 2 or vectors.shape[1] not in (_SMPLH_VALUES, _SMPLX_VALUES, _SMPL_VALUES):
        raise BadData(
            f"The pose vectors have shape {vectors.shape}; 156 (SMPL-H), 165 (SMPL-X) or 72 (SMPL) "
            "values per frame are known.",
            f"{file.path}: poses",
            "Give an AMASS file, a smpl_params.npz or a BVH file.",
        )
    frames = len(vectors)
    if not 0 < frames <= MAX_FRAMES:
        raise BadData(f"The file has {frames} frames.", f"{file.path}: poses", "Give at least one frame.")
    translation = file.array("trans").astype(np.float64)
    if translation.shape != (frames, 3):
        raise BadData(
            f"trans has shape {translation.shape}, expected {(frames, 3)}.",
            f"{file.path}: trans",
            "Give one translation per frame.",
        )
    rotations = _rotations(vectors)
    fps = next(
        (
            positive_fps(file.array(n), file)
            for n in ("mocap_framerate", "mocap_frame_rate", "fps")
            if n in file
        ),
        DEFAULT_FPS,
    )
    pelvis = np.zeros(3) if body is None else body.joint_template[0]
    if z_up:
        rotations = y_up_roots(rotations)
        translation = (translation + pelvis) @ Y_UP_FROM_Z_UP.T - pelvis
    return Poses(
        rotations.astype(np.float32),
        translation.astype(np.float32),
        np.zeros(SHAPE_COUNT, dtype=np.float32),
        np.zeros((frames, EXPRESSION_COUNT), dtype=np.float32),
        fps,
    )


def y_up_roots(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotations (T, 55, 3) with the root turned from a z-up to a y-up world."""
    import roma  # loads the whole of torch._dynamo: two seconds

    turned = torch.from_numpy(Y_UP_FROM_Z_UP) @ roma.rotvec_to_rotmat(torch.from_numpy(rotations[:, 0]))
    result = rotations.copy()
    result[:, 0] = roma.rotmat_to_rotvec(turned).numpy()
    return result


def _rotations(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T, 55, 3) axis-angle from pose vectors of any of the known lengths."""
    frames, values = vectors.shape
    joints = vectors.reshape(frames, -1, 3)
    if values == _SMPLX_VALUES:
        return joints.copy()
    rotations = np.zeros((frames, JOINT_COUNT, 3))
    rotations[:, 0] = joints[:, 0]
    rotations[:, BODY] = joints[:, 1:22]
    if values == _SMPLH_VALUES:
        rotations[:, LEFT_HAND] = joints[:, 22:37]
        rotations[:, RIGHT_HAND] = joints[:, 37:52]
    return rotations
