"""A dressed person as one mesh: body, hair, shoes and garments, with colours, patterns and labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.shared.body import JOINT_INDEX, Poses
from stages.shared.layers import BODY, SKIN, label_id
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
        name: what it is; label: id of hair or shoe.
        vertices: (V, 3) metres, rest frame of the wearer; faces: (F, 3); weights: (V, 55).
        color: albedo, sRGB 0..1.
    """

    name: str
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
        parts: name and vertex range of each part.
    """

    faces: NDArray[np.int64]
    face_label: NDArray[np.uint8]
    face_fabric: NDArray[np.int64]
    corner_uv: Doubles
    vertex_colors: Doubles
    vertex_label: NDArray[np.uint8]
    fabrics: Doubles
    parts: tuple[tuple[str, int, int], ...]


def accessories(mean: ShapedBody, wearer: ShapedBody, person: Person, spacing: float) -> list[Bound]:
    """Hair and shoes, fitted to the wearer; `spacing` of their vertices in metres."""
    offsets = wearer.rest_vertices - mean.rest_vertices
    pieces = [("hair", HAIR, hair_cap(mean, spacing, person.hair_length), person.hair)]
    pieces += [(f"shoe {side:+d}", SHOE, shoe(mean, spacing, side), person.shoes) for side in (1, -1)]
    bound = []
    for name, label, (vertices, faces), color in pieces:
        weights = np.maximum(mean.transfer(vertices, faces, mean.weights), 0.0)
        if label == HAIR:
            weights[:] = np.eye(weights.shape[1])[JOINT_INDEX["head"]]
        weights /= weights.sum(axis=1, keepdims=True)
        fitted = vertices + mean.transfer(vertices, faces, offsets)
        bound.append(Bound(name, label, fitted, faces, weights, color))
    return bound


def look_of(body: ShapedBody, person: Person, bound: list[Bound], garments: list[Garment]) -> Look:
    """The static half of a dressed person."""
    plain = np.zeros(ROW_LENGTH)
    plain[0], plain[1] = VERTEX_COLORS, 1.0
    faces, labels, fabric_of, uvs, colors, vertex_labels = [], [], [], [], [], []
    parts: list[tuple[str, int, int]] = []
    fabrics = [plain]
    start = 0

    def append(
        name: str, label: int, count: int, triangles: NDArray[np.int64], color: Doubles, row: int, uv: Doubles
    ) -> None:
        nonlocal start
        faces.append(triangles + start)
        labels.append(np.full(len(triangles), label, dtype=np.uint8))
        fabric_of.append(np.full(len(triangles), row, dtype=np.int64))
        uvs.append(uv)
        colors.append(np.broadcast_to(linear_from_srgb(color), (count, 3)))
        vertex_labels.append(np.full(count, label, dtype=np.uint8))
        parts.append((name, start, start + count))
        start += count

    no_uv = np.zeros((len(body.faces), 3, 2))
    append(BODY, SKIN, len(body.rest_vertices), body.faces, _body_colors(body, person), 0, no_uv)
    for piece in bound:
        uv = np.zeros((len(piece.faces), 3, 2))
        append(piece.name, piece.label, len(piece.vertices), piece.faces, _shaded(piece), 0, uv)
    for garment in garments:
        fabrics.append(garment.fabric.row())
        count = len(garment.vertices)
        grey = np.full(3, 0.5)
        append(garment.layer, garment.label, count, garment.faces, grey, len(fabrics) - 1, garment.corner_uv)
    return Look(
        np.concatenate(faces),
        np.concatenate(labels),
        np.concatenate(fabric_of),
        np.concatenate(uvs),
        np.concatenate(colors),
        np.concatenate(vertex_labels),
        np.stack(fabrics),
        tuple(parts),
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
