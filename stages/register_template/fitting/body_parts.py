"""Head, hands and feet as vertices of the body: parts that clothes seldom hide."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from stages.shared.body import BodyModel
from stages.shared.body.skeleton import JOINT_INDEX, LEFT_HAND, RIGHT_HAND
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene

_FAR_M = 0.05  # half of a part farther than this from the template's surface is named
_JOINTS: Final = {
    "head": [JOINT_INDEX["head"], JOINT_INDEX["jaw"]],
    "left hand": [JOINT_INDEX["left_wrist"], *range(LEFT_HAND.start, LEFT_HAND.stop)],
    "right hand": [JOINT_INDEX["right_wrist"], *range(RIGHT_HAND.start, RIGHT_HAND.stop)],
    "left foot": [JOINT_INDEX["left_ankle"], JOINT_INDEX["left_foot"]],
    "right foot": [JOINT_INDEX["right_ankle"], JOINT_INDEX["right_foot"]],
}
BARE_PARTS: Final = tuple(_JOINTS)


def part_vertices(body: BodyModel, part: str) -> NDArray[np.intp]:
    """Numbers (K,) of the vertices of one of `BARE_PARTS`."""
    return np.flatnonzero(np.isin(body.skin_weights.argmax(axis=1), _JOINTS[part]))


def parts_far_from(template: Mesh, posed: NDArray[np.float64], body: BodyModel) -> list[str]:
    """Parts of the posed body (V, 3), metres, that are far from the dressed person's surface."""
    scene = RayScene(template.vertices, template.faces)
    return [
        part for part in BARE_PARTS if np.median(scene.distance(posed[part_vertices(body, part)])) > _FAR_M
    ]
