"""A dressed person as one mesh: body, hair, shoes and garments, with colours, patterns and labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.shared.body import JOINT_INDEX, Poses
from stages.shared.layers import SKIN, label_id
from stages.shared.pictures.srgb import linear_from_srgb
from stages.synth.bodies import Person, ShapedBody
from stages.synth.cuts import hair_cap, shoe
from stages.synth.garments import Garment
from stages.synth.textures import ROW_LENGTH, VERTEX_COLORS

Doubles = NDArray[np.float64]

HAIR, SHOE = label_id("hair"), label_id("shoe")


@dataclass(frozen=True, eq=False)
class Bound:
    """A mesh that moves with the bones: hair or a shoe.

    Attributes:
        label: id of hair or shoe.
        vertices: (V, 3) metres, rest frame of the wearer; faces: (F, 3); weights: (V, 55).
        color: albedo, sRGB 0..1.
    """

    label: int
    vertices: Doubles
    faces: NDArray[np.int64]
    weights: Doubles
    color: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Look:
    """What does not change from frame to frame; vertices are body, hair, shoes, garments, in this order.

    Attributes:
        faces: (F, 3) i64.
        face_label: (F,) u8; face_fabric: (F,) i64 row of `fabrics`.
        corner_uv: (F, 3, 2) metres.
        vertex_colors: (V, 3) linear albedo, for parts without a pattern.
        vertex_label: (V,) u8.
        fabrics: (P, 20) rows of `Fabric`.
    """

    faces: NDArray[np.int64]
    face_label: NDArray[np.uint8]
    face_fabric: NDArray[np.int64]
    corner_uv: Doubles
    vertex_colors: Doubles
    vertex_label: NDArray[np.uint8]
    fabrics: Doubles


def accessories(mean: ShapedBody, wearer: ShapedBody, person: Person, spacing: float) -> list[Bound]:
    """Hair and shoes, fitted to the wearer; `spacing` of their vertices in metres."""
    offsets = wearer.rest_vertices - mean.rest_vertices
    pieces = [(HAIR, hair_cap(mean, spacing, person.hair_length), person.hair)]
    pieces += [(SHOE, shoe(mean, spacing, side), person.shoes) for side in (1, -1)]
    bound = []
    for label, (vertices, faces), color in pieces:
        weights = np.maximum(mean.transfer(vertices, faces, mean.weights), 0.0)
        if label == HAIR:
            weights[:] = np.eye(weights.shape[1])[JOINT_INDEX["head"]]
        weights /= weights.sum(axis=1, keepdims=True)
        fitted = vertices + mean.transfer(vertices, faces, offsets)
        bound.append(Bound(label, fitted, faces, weights, color))
    return bound


def look_of(body: ShapedBody, person: Person, bound: list[Bound], garments: list[Garment]) -> Look:
    """The static half of a dressed person."""
    plain = np.zeros(ROW_LENGTH)
    plain[0], plain[1] = VERTEX_COLORS, 1.0
    bare = [(SKIN, body.faces, _body_colors(body, person))]
    bare += [(piece.label, piece.faces, _shaded(piece)) for piece in bound]
    pieces = [(label, faces, colors, np.zeros((len(faces), 3, 2)), 0) for label, faces, colors in bare]
    for row, garment in enumerate(garments, start=1):
        grey = np.full((len(garment.vertices), 3), 0.5)
        pieces.append((garment.label, garment.faces, grey, garment.corner_uv, row))
    labels, faces, colors, uvs, rows = zip(*pieces, strict=True)
    vertex_counts, face_counts = [len(one) for one in colors], [len(one) for one in faces]
    starts = np.repeat(np.cumsum([0, *vertex_counts[:-1]]), face_counts)
    return Look(
        np.concatenate(faces) + starts[:, None],
        np.repeat(np.array(labels, dtype=np.uint8), face_counts),
        np.repeat(np.array(rows, dtype=np.int64), face_counts),
        np.concatenate(uvs),
        linear_from_srgb(np.concatenate(colors)),
        np.repeat(np.array(labels, dtype=np.uint8), vertex_counts),
        np.stack([plain, *(garment.fabric.row() for garment in garments)]),
    )


def vertices_at(
    frame: int, body: ShapedBody, poses: Poses, bound: list[Bound], cloth: list[NDArray[np.float32]]
) -> Doubles:
    """(V, 3) metres, world: all vertices of the dressed person in one frame, in the order of `Look`."""
    transforms = body.transforms(poses.rotations[frame], poses.translation[frame])
    pieces = [body.pose(body.rest_vertices, body.weights, transforms)]
    pieces += [body.pose(piece.vertices, piece.weights, transforms) for piece in bound]
    pieces += [positions[frame].astype(np.float64) for positions in cloth]
    return np.concatenate(pieces)


def _body_colors(body: ShapedBody, person: Person) -> Doubles:
    """(V, 3) sRGB: skin, a little redder at hands and face, eyes with dark irises."""
    owner = body.weights.argmax(axis=1)
    colors = np.tile(np.array(person.skin), (len(owner), 1))
    warm = np.isin(owner, [JOINT_INDEX[n] for n in ("head", "jaw", "left_wrist", "right_wrist")])
    colors[warm] *= (1.02, 0.97, 0.95)
    for name in ("left_eye_smplhf", "right_eye_smplhf", "left_eye", "right_eye"):
        if name not in JOINT_INDEX:
            continue
        eye = owner == JOINT_INDEX[name]
        if not eye.any():
            continue
        colors[eye] = (0.92, 0.92, 0.92)
        points = body.rest_vertices
        middle = 0.5 * (points[eye].min(axis=0) + points[eye].max(axis=0))
        iris = eye & (np.hypot(*(points - middle)[:, :2].T) < 0.0065) & (points[:, 2] > middle[2])
        colors[iris] = (0.14, 0.09, 0.06)
    return np.clip(colors, 0.0, 1.0)


def _shaded(piece: Bound) -> Doubles:
    """(V, 3) sRGB: strands of hair by angle, a lighter sole."""
    colors = np.tile(np.array(piece.color), (len(piece.vertices), 1))
    points = piece.vertices
    if piece.label == HAIR:
        angle = np.arctan2(points[:, 0], points[:, 2] - points[:, 2].mean())
        colors *= (1.0 + 0.22 * np.sin(23 * angle) * np.sin(7 * angle + 9.0 * points[:, 1]))[:, None]
    else:
        colors[points[:, 1] < points[:, 1].min() + 0.016] = (0.88, 0.87, 0.84)
    return np.clip(colors, 0.0, 1.0)
