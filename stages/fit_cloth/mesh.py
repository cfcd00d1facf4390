"""The simulation mesh of a garment: remeshed from its layer, with pins and riding texels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.fit_cloth.openings import close_holes, highest_rim
from stages.fit_cloth.welding import weld
from stages.shared.avatar.deform import blended, moved, shaped_positions
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import JOINT_INDEX, BodyModel, Poses, posed_joints
from stages.shared.cloth.balance import balanced
from stages.shared.cloth.body_surface import BodyCollider
from stages.shared.cloth.material import Material
from stages.shared.cloth.pattern import ClothPattern
from stages.shared.cloth.remeshing import simulation_mesh
from stages.shared.cloth.riding import ride
from stages.shared.cloth.simulator import SKIN_MARGIN
from stages.shared.cloth.surface import template_margins
from stages.shared.meshes import RayScene, components, edges, face_normals, keep_faces

WAIST_BAND = 0.03  # metres around the upper rim of a skirt or of trousers that follow the body
COLLAR_BAND = 0.06  # metres below the top of a jacket, at its back
_ISLAND = 0.05  # of the vertices of a simulation mesh
_SHORTEST = 1e-3  # m, of a rest length; shorter edges would make the springs of their triangles explode
_DEEPEST = -0.05  # metres that a template may lie inside the body
_VERTEX_AREA = 0.866  # of the squared edge length: a vertex's share of an equilateral mesh


def build_pattern(
    name: str,
    layer: dict[str, NDArray[Any]],
    maps: LayerMaps,
    body: BodyModel,
    pose: Poses,
    vertices: int,
    material: Material,
) -> ClothPattern:
    """The pattern of one garment with a first material.

    Arguments:
        layer: arrays of segment-layers. maps: baked maps. pose: one row, the template's pose.
        vertices: of the simulation mesh, about.
    """
    area = float(face_normals(layer["world_vertices"], layer["faces"])[1].sum())
    edge = float(np.sqrt(area / (_VERTEX_AREA * vertices)))
    joints = _joints(body, pose)
    sheet = weld(layer["world_vertices"].astype(np.float64), layer["faces"], edge)
    rest, faces = simulation_mesh(*close_holes(*sheet, joints), edge)
    rest, faces = without_loose_pieces(rest, faces, pins(name, rest, faces, joints))
    attributes = _from_layer(layer, rest)
    collider = BodyCollider(body, pose.betas, material.skin_friction)
    at = collider.vertices(pose.rotations[0], pose.translation[0])
    margins = template_margins(rest, at, collider.surface.faces, SKIN_MARGIN, _DEEPEST)
    texels = _posed_texels(maps, body, pose)
    riding = ride(texels, rest, faces)
    ends = rest[edges(faces)]
    pattern = ClothPattern(
        vertices=attributes["vertices"],
        rest_vertices=rest.astype(np.float32),
        rest_lengths=_not_too_short(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)),
        faces=faces,
        pinned=pins(name, rest, faces, joints).astype(np.int32),
        skin_margin=margins.astype(np.float32),
        skin_weights=attributes["skin_weights"],
        shape_directions=attributes["shape_directions"],
        pose=pose.rotations[0].astype(np.float32),
        texel_faces=riding.face,
        texel_weights=riding.barycentric,
        texel_offsets=riding.offset,
        material=material,
        betas=pose.betas,
    )
    return with_material(pattern, material, body, pose)


def with_material(
    pattern: ClothPattern, material: Material, body: BodyModel, pose: Poses, detail: float = 1.0
) -> ClothPattern:
    """The pattern of another material, with rest lengths in balance where the material asks for them."""
    ends = pattern.rest_vertices.astype(np.float64)[edges(pattern.faces)]
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    pattern = replace(pattern, material=material, rest_lengths=_not_too_short(lengths))
    if not material.balanced:
        return pattern
    collider = BodyCollider(body, pose.betas, material.skin_friction)
    at = collider.vertices(pose.rotations[0], pose.translation[0])
    constraints = balanced(pattern.garment("cloth"), collider.surface, at, detail).constraints
    # Constraints are sorted by colour; the pattern keeps edges in the order of `meshes.edges`.
    pairs = np.sort(constraints.edges, axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return replace(pattern, rest_lengths=_not_too_short(constraints.edge_rest[order]))


def _not_too_short(lengths: NDArray[np.float64]) -> NDArray[np.float32]:
    """(E,) rest lengths of at least `_SHORTEST`: remeshing leaves a few edges of almost no length."""
    return np.maximum(lengths, _SHORTEST).astype(np.float32)


def without_loose_pieces(
    vertices: NDArray, faces: NDArray, pinned: NDArray[np.bool_]
) -> tuple[NDArray, NDArray]:
    """The mesh without pieces that nothing would hold up: they would fall out of the picture.

    Those are pieces of less than `_ISLAND` of the vertices, and of a garment with pins those without one.
    Texels of such a piece ride on the nearest triangle of the rest.
    """
    piece = components(faces, len(vertices))
    held = np.bincount(piece) >= _ISLAND * len(vertices)
    if pinned.any():
        held &= np.bincount(piece, pinned) > 0
    kept, used = keep_faces(faces, held[piece[faces[:, 0]]], len(vertices))
    return vertices[used], kept


def pins(name: str, rest: NDArray, faces: NDArray, joints: NDArray) -> NDArray[np.bool_]:
    """(V,) vertices that follow the body: the waist of a lower garment, the back collar of an outer one.

    A T-shirt has no pins, and neither has a dress, which hangs from the shoulders.

    Arguments:
        rest: (V, 3) m, world, template's pose. joints: (55, 3) m in the same pose.
    """
    height, top = rest[:, 1], float(np.quantile(rest[:, 1], 0.995))
    nothing = np.zeros(len(rest), dtype=bool)
    if name == "lower":
        if top > joints[JOINT_INDEX["spine3"], 1]:
            return nothing
        waist = highest_rim(rest, faces)
        if not len(waist):
            return np.asarray(height > top - WAIST_BAND)
        return np.asarray(cKDTree(rest[waist]).query(rest)[0] < WAIST_BAND)
    if name == "outer":
        neck, spine = joints[JOINT_INDEX["neck"]], joints[JOINT_INDEX["spine2"]]
        left = joints[JOINT_INDEX["left_shoulder"]] - joints[JOINT_INDEX["right_shoulder"]]
        forward = np.cross(left, neck - spine)
        behind = (rest - neck) @ forward < 0
        return np.asarray(behind & (height > top - COLLAR_BAND))
    return nothing


def _from_layer(layer: dict[str, NDArray[Any]], points: NDArray) -> dict[str, NDArray[np.float32]]:
    """Canonical place, skinning weights and shape directions of points on the layer's world mesh."""
    _, face, weights = RayScene(layer["world_vertices"], layer["faces"]).closest(points)
    corners = layer["faces"][face]
    result = {
        name: np.einsum("vk,vk...->v...", weights, layer[name][corners].astype(np.float32))
        for name in ("vertices", "skin_weights", "shape_directions")
    }
    skin = np.maximum(result["skin_weights"], 0.0)
    result["skin_weights"] = skin / skin.sum(axis=1, keepdims=True)
    return {name: array.astype(np.float32) for name, array in result.items()}


def _posed_texels(maps: LayerMaps, body: BodyModel, pose: Poses) -> NDArray:
    """(N, 3) m, world, of the texels in the template's pose, without learned offsets."""
    arrays = (pose.rotations[0], pose.translation[0], pose.betas)
    bones = frame_pose(body, *(torch.from_numpy(array) for array in arrays))
    points = shaped_positions(maps, bones.betas)
    return moved(points, blended(maps.skin_weights, bones.transforms)).numpy().astype(np.float64)


def _joints(body: BodyModel, pose: Poses) -> NDArray:
    arrays = (pose.rotations[0], pose.translation[0], pose.betas)
    return posed_joints(body, *(torch.from_numpy(array) for array in arrays)).numpy()
