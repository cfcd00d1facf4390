"""The layer meshes: garments cut from the template, and the body with hair and shoes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from stages.segment_layers.config import SegmentLayersConfig
from stages.segment_layers.extract import LayerPart, extract_part, faces_beneath, join, sink
from stages.segment_layers.hidden_cloth import BodySurface, lower_onto_body
from stages.shared.artifacts import Artifact
from stages.shared.body.model import BodyModel
from stages.shared.body.posed import posed_body
from stages.shared.body.skeleton import JOINT_INDEX
from stages.shared.layers import (
    BODY_LABELS,
    GARMENT_LABELS,
    ONE_PIECE,
    OUTERMOST_FIRST,
    SKIN,
    garments_of,
    label_of,
)
from stages.shared.meshes import keep_faces
from stages.shared.meshes.regions import face_labels, outward_faces
from stages.shared.meshes.topology import vertex_normals
from stages.shared.poses.read import load_poses

UPPER, OUTER = label_of("upper"), label_of("outer")
_LEGS = [JOINT_INDEX[f"{side}_{name}"] for side in ("left", "right") for name in ("hip", "knee", "ankle")]
_TORSO_AND_ARMS = [
    *(JOINT_INDEX[name] for name in ("spine2", "spine3", "neck")),
    *(
        JOINT_INDEX[f"{side}_{name}"]
        for side in ("left", "right")
        for name in ("collar", "shoulder", "elbow")
    ),
]
_ONE_PIECE = 0.15  # share of the weights on either half
LayerMesh = dict[str, np.ndarray]  # arrays of one layer's mesh, as the stage writes them
_SCAN_REACH = 0.02  # metres: body vertices take the colour of scan skin that is this near


@dataclass(frozen=True)
class Template:
    """The template in the world and in canonical space, with the same vertices.

    Attributes:
        world: (V, 3) float64 metres. normals: (V, 3) world.
        faces: (F, 3), those that canonicalize kept, turned outward.
        canonical: vertices, skin_weights, shape_directions of the zero shape.
        canonical_normals: (V, 3). colors: (V, 3) u8 or None. labels: (V,) u8 or None.
    """

    world: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    canonical: dict[str, np.ndarray]
    canonical_normals: np.ndarray
    colors: np.ndarray | None
    labels: np.ndarray | None

    @classmethod
    def load(cls, registered: dict[str, np.ndarray], canonical: dict[str, np.ndarray]) -> Template:
        """From the arrays of the two earlier stages."""
        world = registered["vertices"].astype(np.float64)
        faces = outward_faces(world, canonical["faces"])
        return cls(
            world,
            faces,
            vertex_normals(world, faces).astype(np.float64),
            {name: canonical[name] for name in ("vertices", "skin_weights", "shape_directions")},
            vertex_normals(canonical["vertices"], faces).astype(np.float64),
            registered.get("colors"),
            registered.get("labels"),
        )


def garment_layer(
    template: Template, labels: np.ndarray, label: int, config: SegmentLayersConfig, body: BodySurface
) -> LayerMesh:
    """Mesh of one garment, its border tucked under its neighbours; empty when it is not there.

    It continues under garments that lie over it (`faces_beneath`), lowered onto the body.
    """
    by_face = face_labels(labels, template.faces, OUTERMOST_FIRST)
    own = by_face == label
    under = np.isin(by_face, [other for other in GARMENT_LABELS if other != label])
    over = np.isin(by_face, GARMENT_LABELS[GARMENT_LABELS.index(label) + 1 :])
    beneath = faces_beneath(template.world, template.faces, own, over, config.beneath_m, gap=0.01)
    if label == UPPER:
        outer = by_face == OUTER
        beneath |= faces_beneath(template.world, template.faces, own, outer, config.beneath_outer_m)
    part = extract_part(template.faces, own, under, config.extended_rings, len(labels), beneath)
    mesh = _part_mesh(template, part, label, config.ring_depth_m)
    return _lowered(mesh, body) if len(part.faces) else mesh


def _lowered(mesh: LayerMesh, body: BodySurface) -> LayerMesh:
    """A garment mesh with its hidden part on the body; faces of folded flaps are left out."""
    cloth = lower_onto_body(
        mesh["world_vertices"].astype(np.float64), mesh, mesh["faces"], mesh["ring"] > 0, body
    )
    lowered = {
        **mesh,
        "vertices": cloth.canonical.astype(np.float32),
        "skin_weights": cloth.skin_weights.astype(np.float32),
        "shape_directions": cloth.shape_directions.astype(np.float32),
        "world_vertices": cloth.world.astype(np.float32),
    }
    faces, used = keep_faces(mesh["faces"], ~cloth.folded, len(mesh["vertices"]))
    return {name: faces if name == "faces" else values[used] for name, values in lowered.items()}


def body_surface(registered: Artifact, canonical: Artifact) -> BodySurface:
    """The body of the template's frame, in the world and in canonical space."""
    body = BodyModel.from_arrays(registered.arrays("body"))
    pose = load_poses(registered.file("smpl_params.npz"))[int(registered.summary["frame"])]
    mesh = canonical.arrays("body")
    arrays = (mesh[name] for name in ("vertices", "faces", "skin_weights", "shape_directions"))
    return BodySurface(posed_body(body, pose), *arrays)


def body_layer(template: Template, labels: np.ndarray, body: BodySurface) -> LayerMesh:
    """The body model's own mesh, whole under the garments, and the hair and shoes of the template."""
    by_face = face_labels(labels, template.faces, OUTERMOST_FIRST)
    nothing = np.zeros(len(by_face), dtype=bool)
    parts = [_body_mesh(template, labels, body)]
    for label in reversed(BODY_LABELS):  # hair and shoes; the skin is the body model's own
        if label == SKIN:
            continue
        part = extract_part(template.faces, by_face == label, nothing, 0, len(labels))
        if len(part.faces):
            parts.append(_part_mesh(template, part, label, 0.0))
    return join(parts)


def _body_mesh(template: Template, labels: np.ndarray, body: BodySurface) -> LayerMesh:
    count = len(body.world)
    colors, seen = np.zeros((count, 3), np.uint8), np.zeros(count, np.uint8)
    skin = np.flatnonzero(labels == SKIN)
    if template.colors is not None and len(skin):
        distance, nearest = cKDTree(template.world[skin]).query(body.world)
        colors = template.colors[skin][nearest]
        seen = (distance < _SCAN_REACH).astype(np.uint8)
    return {
        "vertices": body.canonical,
        "faces": body.faces,
        "skin_weights": body.skin_weights,
        "shape_directions": body.shape_directions,
        "world_vertices": body.world.astype(np.float32),
        "labels": np.full(count, SKIN, np.uint8),
        "ring": np.zeros(count, np.int32),
        "scan_colors": colors,
        "scan_seen": seen,
    }


def _part_mesh(template: Template, part: LayerPart, label: int, depth: float) -> LayerMesh:
    numbers = part.vertex_numbers
    canonical = {name: values[numbers] for name, values in template.canonical.items()}
    canonical["vertices"] = sink(
        canonical["vertices"].astype(np.float64), template.canonical_normals[numbers], part.ring, depth
    ).astype(np.float32)
    world = sink(template.world[numbers], template.normals[numbers], part.ring, depth)
    colors = (
        template.colors[numbers] if template.colors is not None else np.zeros((len(numbers), 3), np.uint8)
    )
    return {
        **canonical,
        "faces": part.faces.astype(np.int32),
        "world_vertices": world.astype(np.float32),
        "labels": np.full(len(numbers), label, np.uint8),
        "ring": part.ring.astype(np.int32),
        "scan_colors": colors,
        "scan_seen": np.full(len(numbers), template.colors is not None, np.uint8),
    }


def slots_of(layers: dict[str, LayerMesh]) -> dict[str, list[str]]:
    """The places that each garment takes up: its own, or upper and lower for a dress or a jumpsuit.

    A garment is one piece when the other of upper and lower is not there and a good part of its vertices
    follows the torso and the arms, and a good part the legs.
    """
    slots = {name: [name] for name in garments_of(layers)}
    for name, other in (ONE_PIECE, ONE_PIECE[::-1]):
        if name in layers and other not in layers:
            mesh = layers[name]
            weights = mesh["skin_weights"][mesh["ring"] == 0]
            leg = float(weights[:, _LEGS].sum(axis=1).mean()) if len(weights) else 0.0
            torso = float(weights[:, _TORSO_AND_ARMS].sum(axis=1).mean()) if len(weights) else 0.0
            if min(leg, torso) > _ONE_PIECE:
                slots[name] = list(ONE_PIECE)
    return slots
