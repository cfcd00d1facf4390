"""Garments on a moving body: from the rest pose into frame 0, then through the motion.

The engine is the one that drives garments later (`stages.shared.cloth`), with other settings: a finer mesh,
other materials, another air drag, other pins. So a driver never meets a truth made with its own settings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.shared.body import Poses
from stages.shared.cloth.body_surface import BodyCollider
from stages.shared.cloth.motion import BodyStep, lead_in, steps_between
from stages.shared.cloth.simulator import Simulator, garment
from stages.synth.bodies import ShapedBody
from stages.synth.garments import Garment

BODY_FRICTION = 0.4


def simulate(
    body: ShapedBody, garments: list[Garment], poses: Poses, steps_per_second: float
) -> list[NDArray[np.float32]]:
    """Positions of every garment in every frame.

    Arguments:
        garments: inner layer first; each stays outside the body and outside those before it.
        poses: T frames without cuts.
        steps_per_second: simulation steps.

    Returns:
        per garment (T, V, 3) f32 metres, world.
    """
    collider = BodyCollider(body.model, body.betas, BODY_FRICTION)
    rest_pose = np.zeros_like(poses.rotations[0])
    cloth = [
        garment(
            one.name,
            one.vertices,
            one.faces,
            one.pinned,
            replace(one.material, steps_per_second=steps_per_second),
            one.distance,
        )
        for one in garments
    ]
    simulator = Simulator(collider.surface, cloth)

    def on_bones(step: BodyStep) -> list[NDArray[np.float64]]:
        transforms = body.transforms(step.rotations, step.translation)
        return [body.pose(one.vertices, one.skin_weights, transforms) for one in garments]

    def advance(step: BodyStep) -> None:
        pins = [shape[one.pinned] for shape, one in zip(on_bones(step), garments, strict=True)]
        simulator.advance(collider.vertices(step.rotations, step.translation), pins, step.seconds)

    first, *settling = lead_in(rest_pose, poses, 0)
    simulator.place(collider.vertices(first.rotations, first.translation), on_bones(first))
    frames = []
    for row in range(len(poses)):
        for step in settling if row == 0 else steps_between(poses, row):
            advance(step)
        frames.append([state.positions.astype(np.float32) for state in simulator.states])
    return [np.stack(sequence) for sequence in zip(*frames, strict=True)]
