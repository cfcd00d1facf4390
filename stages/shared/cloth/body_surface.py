"""The part of a body that cloth may touch."""

from __future__ import annotations

from stages.shared.body import JOINT_INDEX, BodyModel
from stages.shared.cloth.surface import Surface

FIRST_UNUSED_JOINT = JOINT_INDEX[
    "jaw"
]  # jaw, eyes and fingers: thin or hidden parts that cloth would catch on


def body_surface(body: BodyModel, friction: float) -> Surface:
    """The body without head and fingers as a surface of all its vertices."""
    joint = body.skin_weights.argmax(axis=1)
    touchable = (joint < FIRST_UNUSED_JOINT) & (joint != JOINT_INDEX["head"])
    faces = body.faces[touchable[body.faces].all(axis=1)]
    return Surface(faces, len(body.template_vertices), closed=True, friction=friction)
