"""Height and girth of a body, as a tape would measure them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from stages.shared.body import JOINT_INDEX, BodyModel, shaped_joints, shaped_vertices

_SLICE = 0.02  # m above and below the waist
_TRUNK = ("pelvis", "spine1", "spine2", "spine3")


def body_measures(body: BodyModel, betas: NDArray[np.float32]) -> dict[str, float]:
    """Height of the standing body and girth at the waist, in centimetres.

    The girth is the perimeter of the convex hull of a slice of the trunk, as a tape lies around it.

    Arguments:
        betas: (10,) shape.
    """
    shape = torch.from_numpy(np.asarray(betas, np.float32))
    vertices = shaped_vertices(body, shape).numpy()
    joints = shaped_joints(body, shape).numpy()
    waist = float(joints[JOINT_INDEX["spine1"], 1])
    trunk = np.asarray(body.skin_weights)[:, [JOINT_INDEX[name] for name in _TRUNK]].sum(axis=1) > 0.5
    ring = vertices[trunk & (np.abs(vertices[:, 1] - waist) < _SLICE)][:, [0, 2]]
    girth = ConvexHull(ring).area if len(ring) > 3 else 0.0  # of two dimensions, `area` is the perimeter
    height = float(vertices[:, 1].max() - vertices[:, 1].min())
    return {"height_cm": round(100 * height, 1), "girth_cm": round(100 * float(girth), 1)}
