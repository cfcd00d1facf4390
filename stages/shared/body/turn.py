"""A pose sequence in a turned world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses


def turned_poses(body: BodyModel, poses: Poses, turn: NDArray[np.floating]) -> Poses:
    """The poses whose vertices are `turn` (3, 3) times those of `poses`.

    The root turns about the pelvis joint J0, not about the origin: v = R (x − J0) + J0 + τ, so the turned
    translation is turn (J0 + τ) − J0.
    """
    pelvis = body.joint_template[0] + body.joint_directions[0] @ poses.betas
    rotations = poses.rotations.copy()
    root = Rotation.from_matrix(turn) * Rotation.from_rotvec(rotations[:, 0])
    rotations[:, 0] = root.as_rotvec()
    translation = (poses.translation + pelvis) @ np.asarray(turn, np.float64).T - pelvis
    return replace(poses, rotations=rotations, translation=translation.astype(np.float32))
