"""The part of a body that cloth may touch, in any pose, fast."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse

from stages.shared.body import JOINT_INDEX, BodyModel, shaped_joints, shaped_vertices
from stages.shared.body.kinematics import bone_transforms, rotation_matrices
from stages.shared.cloth.surface import Surface

Doubles = NDArray[np.float64]

FIRST_UNUSED_JOINT = JOINT_INDEX[
    "jaw"
]  # jaw, eyes and fingers: thin or hidden parts that cloth would catch on


class BodyCollider:
    """A body of one shape without head and fingers.

    Arguments:
        body: the body model. betas: (10,) shape. friction: Coulomb coefficient of the skin.

    Attributes:
        surface: its topology; `vertices` are in the same order.
    """

    def __init__(self, body: BodyModel, betas: NDArray, friction: float) -> None:
        joint = body.skin_weights.argmax(axis=1)
        touchable = (joint < FIRST_UNUSED_JOINT) & (joint != JOINT_INDEX["head"])
        faces = body.faces[touchable[body.faces].all(axis=1)]
        used = np.unique(faces)
        shape = torch.as_tensor(np.asarray(betas), dtype=torch.float64)
        self._joints = shaped_joints(body, shape)
        self._rest = shaped_vertices(body, shape).numpy()[used]
        self._weights = sparse.csr_array(body.skin_weights[used].astype(np.float64))
        self._correctives = (
            None
            if body.pose_directions is None
            else body.pose_directions.reshape(len(body.pose_directions), -1, 3)[:, used].astype(np.float64)
        )
        self.surface = Surface(np.searchsorted(used, faces), len(used), closed=True, friction=friction)

    def vertices(self, rotations: NDArray, translation: NDArray) -> Doubles:
        """(B, 3) metres, world, in a pose: rotations (55, 3) axis-angle, translation (3,) metres."""
        turns = torch.as_tensor(np.asarray(rotations), dtype=torch.float64)
        move = torch.as_tensor(np.asarray(translation), dtype=torch.float64)
        transforms = bone_transforms(turns, self._joints, translation=move).numpy()
        rest = self._rest
        if self._correctives is not None:
            feature = (rotation_matrices(turns)[1:] - torch.eye(3, dtype=torch.float64)).numpy().ravel()
            rest = rest + np.tensordot(feature, self._correctives, axes=1)
        blended = (self._weights @ transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        return np.asarray((blended[:, :, :3] @ rest[:, :, None])[:, :, 0] + blended[:, :, 3])
