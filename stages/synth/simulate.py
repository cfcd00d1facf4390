"""Garments on a moving body: settle from the rest pose into frame 0, then follow the motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from stages.shared.body import JOINT_INDEX, Poses
from stages.shared.report import SILENT, Report
from stages.synth import cloth
from stages.synth.bodies import ShapedBody
from stages.synth.collision import Collider, push_out
from stages.synth.garments import Garment
from stages.synth.motion import FPS

Doubles = NDArray[np.float64]

BODY_FRICTION = 0.45
CLOTH_FRICTION = 0.2
SWEEPS = 2  # over the edges, per step
EDGE_DAMPING, WING_DAMPING = 0.5, 0.08  # share of the relative speed lost per step
CLOTH_DISTANCE = 0.004  # metres between two garments


@dataclass(eq=False)
class _Worn:
    """A garment while it is simulated."""

    garment: Garment
    model: cloth.ClothModel
    positions: Doubles
    previous: Doubles
    velocities: Doubles
    normals: Doubles
    collider: Collider
    on_body: NDArray[np.int64]
    on_cloth: list[NDArray[np.int64]]


def simulate(
    body: ShapedBody,
    garments: list[Garment],
    poses: Poses,
    settle_frames: int,
    substeps: int,
    report: Report = SILENT,
) -> list[NDArray[np.float32]]:
    """Positions of every garment in every frame.

    Arguments:
        garments: inner layer first; each keeps outside the body and outside those before it.
        poses: T frames at 30 frames/s.
        settle_frames: frames from the rest pose to frame 0 (two thirds moving, one third waiting).
        substeps: steps per frame.

    Returns:
        per garment (T, V, 3) f32 metres, world.
    """
    rotations, translations = _with_run_up(poses, settle_frames)
    transforms = body.transforms(rotations, translations)
    collider = Collider(body.faces, _touchable(body), closed=True, friction=BODY_FRICTION)
    surface = body.pose(body.rest_vertices, body.weights, transforms[0])
    normals = np.zeros_like(surface)
    cloth.area_normals(surface, body.faces, normals)
    worn = [_put_on(body, garment, transforms[0]) for garment in garments]
    targets = [one.positions.copy() for one in worn]
    frames: list[list[NDArray[np.float32]]] = [[] for _ in garments]
    for frame in range(1, len(transforms)):
        next_surface = body.pose(body.rest_vertices, body.weights, transforms[frame])
        next_normals = np.zeros_like(normals)
        cloth.area_normals(next_surface, body.faces, next_normals)
        next_targets = [
            body.pose(one.garment.vertices, one.garment.skin_weights, transforms[frame]) for one in worn
        ]
        _find_contacts(worn, collider, surface)
        before = surface
        for step in range(1, substeps + 1):
            share = step / substeps
            now = surface + share * (next_surface - surface)
            now_normals = normals + share * (next_normals - normals)
            for index, one in enumerate(worn):
                target = targets[index] + share * (next_targets[index] - targets[index])
                _step(one, worn[:index], target, collider, now, before, now_normals, 1 / (FPS * substeps))
            before = now
        surface, normals, targets = next_surface, next_normals, next_targets
        if frame >= settle_frames:
            for index, one in enumerate(worn):
                frames[index].append(one.positions.astype(np.float32))
            report.progress(frame - settle_frames + 1, len(poses))
    return [np.stack(sequence) for sequence in frames]


def _step(
    one: _Worn,
    below: list[_Worn],
    target: Doubles,
    collider: Collider,
    surface: Doubles,
    surface_before: Doubles,
    normals: Doubles,
    seconds: float,
) -> None:
    """One small step of one garment: inertia, cloth constraints, pins, layers below, body."""
    model = one.model
    cloth.predict(one.positions, one.previous, one.velocities, seconds, model.drag)
    cloth.solve_distances(one.positions, model.wings, model.wing_lengths, model.bend_compliance, seconds, 1)
    cloth.solve_distances(one.positions, model.edges, model.rest_lengths, 0.0, seconds, SWEEPS)
    cloth.hold_pins(one.positions, target, one.garment.pinned, seconds)
    for inner, nearest in zip(below, one.on_cloth, strict=True):
        c = inner.collider
        push_out(
            one.positions, one.previous, nearest, inner.positions, inner.previous, inner.normals,
            c.faces, c.first, c.incident, c.border, CLOTH_DISTANCE, c.friction, False,
        )  # fmt: skip
    push_out(
        one.positions, one.previous, one.on_body, surface, surface_before, normals,
        collider.faces, collider.first, collider.incident, collider.border,
        one.garment.distance, collider.friction, True,
    )  # fmt: skip
    cloth.update_velocities(one.positions, one.previous, one.velocities, seconds)
    cloth.damp_distances(one.positions, one.velocities, model.edges, EDGE_DAMPING)
    cloth.damp_distances(one.positions, one.velocities, model.wings, WING_DAMPING)
    cloth.area_normals(one.positions, one.collider.faces, one.normals)


def _put_on(body: ShapedBody, garment: Garment, transforms: Doubles) -> _Worn:
    positions = body.pose(garment.vertices, garment.skin_weights, transforms)
    normals = np.zeros_like(positions)
    cloth.area_normals(positions, garment.faces, normals)
    everywhere = np.ones(len(positions), dtype=bool)
    collider = Collider(garment.faces, everywhere, closed=False, friction=CLOTH_FRICTION)
    model = cloth.cloth_model(garment.vertices, garment.faces)
    nowhere = np.full(len(positions), -1, dtype=np.int64)
    return _Worn(
        garment, model, positions, positions.copy(), np.zeros_like(positions), normals, collider, nowhere, []
    )


def _find_contacts(worn: list[_Worn], collider: Collider, surface: Doubles) -> None:
    """The nearest surface vertex of every cloth vertex, for the coming frame."""
    on_body = collider.tree(surface)
    on_cloth = [one.collider.tree(one.positions) for one in worn[:-1]]
    for index, one in enumerate(worn):
        one.on_body = collider.nearest(on_body, one.positions)
        one.on_cloth = [
            inner.collider.nearest(tree, one.positions)
            for inner, tree in zip(worn[:index], on_cloth, strict=False)
        ]


def _with_run_up(poses: Poses, settle_frames: int) -> tuple[Doubles, Doubles]:
    """(S+T, 55, 3), (S+T, 3): from the rest pose smoothly into frame 0, a wait, then the motion."""
    moving = max(2 * settle_frames // 3, 1)
    share = np.clip(np.arange(settle_frames) / moving, 0.0, 1.0)
    share = share * share * (3 - 2 * share)
    joints = poses.rotations.shape[1]
    run_up = np.zeros((settle_frames, joints, 3))
    for joint in range(joints):
        ends = Rotation.from_rotvec([np.zeros(3), poses.rotations[0, joint].astype(np.float64)])
        run_up[:, joint] = Slerp([0.0, 1.0], ends)(share).as_rotvec()
    translations = np.repeat(poses.translation[:1].astype(np.float64), settle_frames, axis=0)
    return (
        np.concatenate([run_up, poses.rotations.astype(np.float64)]),
        np.concatenate([translations, poses.translation.astype(np.float64)]),
    )


def _touchable(body: ShapedBody) -> NDArray[np.bool_]:
    """(V,) False on fingers, eyes and jaw: thin or hidden parts that cloth could catch on."""
    first_unused = JOINT_INDEX["jaw"]
    return body.weights.argmax(axis=1) < first_unused
