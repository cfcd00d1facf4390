"""A layer's template mesh as skinned glTF: Blender and engines can pose it with the body's 55 joints.

The mesh stands in the canonical pose. The joint nodes carry the canonical pose as their own rotations, and
the inverse bind matrices take it away: with every node's rotation set to a pose of SMPL-X (relative to the
parent), skinning gives Σ_j w_j A_j(θ) A^c_j⁻¹ x, the same as everywhere in `gw`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.artifacts.pictures import encode_png
from stages.shared.body import (
    JOINTS,
    PARENTS,
    BodyModel,
    Poses,
    canonical_from_rest,
    canonical_rotations,
    shaped_joints,
)
from stages.shared.export.glb import ELEMENT_BUFFER, GlbWriter
from stages.shared.export.texture import MeshTexture
from stages.shared.meshes.topology import vertex_normals
from stages.shared.pictures.srgb import linear_from_srgb

JOINTS_PER_VERTEX = 8  # two sets of four, as glTF has them
_CLAMP = 33071  # glTF: what lies beyond the texture has the colour of its border


@dataclass(frozen=True, eq=False)
class SkinnedMesh:
    """A mesh that bones carry.

    Attributes:
        name: of the node. vertices: (V, 3) m, canonical, of zero shape. faces: (F, 3).
        skin_weights: (V, 55). shape_directions: (V, 10, 3) m per unit of shape. colors: (V, 3) u8 sRGB.
        texture: takes the place of the colours.
    """

    name: str
    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    skin_weights: NDArray[np.float32]
    shape_directions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    texture: MeshTexture | None = None


def write_skinned_glb(
    path: Path,
    mesh: SkinnedMesh,
    body: BodyModel,
    betas: NDArray[np.float32],
    poses: Poses | None = None,
    weights_per_vertex: int = JOINTS_PER_VERTEX,
) -> None:
    """Write the mesh with its skeleton, whole or not at all.

    Arguments:
        betas: (10,) shape that mesh and skeleton take.
        poses: a motion to carry along as an animation; its own shape is not used.
        weights_per_vertex: 4 or 8, the largest ones.
    """
    glb = GlbWriter()
    shape = torch.from_numpy(np.asarray(betas, np.float64))
    joints = shaped_joints(body, shape).numpy()
    bind = canonical_from_rest(body, shape).numpy()
    bind = bind @ _translations(joints)  # joint node to world, in the canonical pose
    turned = Rotation.from_rotvec(canonical_rotations(torch.float64).numpy()).as_quat()
    nodes: list[dict[str, object]] = []
    for joint, name in enumerate(JOINTS):
        parent = int(PARENTS[joint])
        step = joints[joint] - (joints[parent] if parent >= 0 else 0)
        node: dict[str, object] = {"name": name, "translation": step.tolist()}
        if not np.allclose(turned[joint], [0, 0, 0, 1]):
            node["rotation"] = turned[joint].tolist()
        children = [child for child, above in enumerate(PARENTS) if above == joint]
        if children:
            node["children"] = children
        nodes.append(node)
    nodes.append({"name": mesh.name, "mesh": 0, "skin": 0})
    inverse = np.linalg.inv(bind).astype(np.float32)
    inverse[:, 3] = [0, 0, 0, 1]  # glTF asks for exactly this row
    glb.content |= {
        "scene": 0,
        "scenes": [{"nodes": [0, len(JOINTS)]}],
        "nodes": nodes,
        "meshes": [{"name": mesh.name, "primitives": [_primitive(glb, mesh, betas, weights_per_vertex)]}],
        "materials": [_material(glb, mesh)],
        "skins": [
            {
                "joints": list(range(len(JOINTS))),
                "skeleton": 0,
                "inverseBindMatrices": glb.array(inverse, target=None),
            }
        ],
    }
    if poses is not None:
        glb.content["animations"] = [_animation(glb, poses, joints[0])]
    glb.write(path)


def strongest_weights(
    weights: NDArray[np.float32], count: int = JOINTS_PER_VERTEX
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Joints (V, count) of the largest weights of each vertex, and those weights, made to sum to 1.

    A joint without weight is given as 0, which glTF validators ask for.
    """
    order = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    kept = np.take_along_axis(weights, order, axis=1).astype(np.float64)
    kept /= np.maximum(kept.sum(axis=1, keepdims=True), 1e-12)
    return np.where(kept > 0, order, 0).astype(np.uint8), kept.astype(np.float32)


def _material(glb: GlbWriter, mesh: SkinnedMesh) -> dict[str, object]:
    surface: dict[str, object] = {"metallicFactor": 0.0}
    if mesh.texture is not None:
        picture = glb.data(encode_png(mesh.texture.image))
        glb.content |= {
            "images": [{"bufferView": picture, "mimeType": "image/png"}],
            "samplers": [{"wrapS": _CLAMP, "wrapT": _CLAMP}],
            "textures": [{"source": 0, "sampler": 0}],
        }
        surface["baseColorTexture"] = {"index": 0}
    return {"name": mesh.name, "doubleSided": True, "pbrMetallicRoughness": surface}


def _primitive(
    glb: GlbWriter, mesh: SkinnedMesh, betas: NDArray[np.float32], weights_per_vertex: int
) -> dict[str, object]:
    shaped = mesh.vertices + np.einsum("b,vbk->vk", betas, mesh.shape_directions)
    joints, weights = strongest_weights(mesh.skin_weights, weights_per_vertex)
    rows, faces = (
        (slice(None), mesh.faces) if mesh.texture is None else (mesh.texture.vertex, mesh.texture.faces)
    )
    attributes = {
        "POSITION": glb.array(shaped[rows].astype(np.float32), bounds=True),
        "NORMAL": glb.array(_normals(shaped, mesh.faces)[rows]),
    }
    if mesh.texture is not None:
        attributes["TEXCOORD_0"] = glb.array(mesh.texture.uvs)
    else:
        color = np.full((len(shaped), 4), 255, np.uint8)
        color[:, :3] = np.rint(255 * linear_from_srgb(mesh.colors / 255.0))
        attributes["COLOR_0"] = glb.array(color, normalized=True)
    for part in range(weights_per_vertex // 4):
        chosen = slice(4 * part, 4 * part + 4)
        attributes[f"JOINTS_{part}"] = glb.array(joints[rows, chosen])
        attributes[f"WEIGHTS_{part}"] = glb.array(weights[rows, chosen])
    indices = glb.array(faces.reshape(-1).astype(np.uint32), ELEMENT_BUFFER)
    return {"attributes": attributes, "indices": indices, "material": 0}


def _animation(glb: GlbWriter, poses: Poses, root: NDArray[np.float64]) -> dict[str, object]:
    """Rotations of every joint and the translation of the root, one key per frame."""
    times = glb.array((np.arange(len(poses)) / poses.fps).astype(np.float32), target=None, bounds=True)
    quats = Rotation.from_rotvec(poses.rotations.reshape(-1, 3).astype(np.float64)).as_quat()
    quats = quats.reshape(len(poses), -1, 4)
    for frame in range(1, len(poses)):  # the shorter way from key to key
        flip = (quats[frame] * quats[frame - 1]).sum(axis=1) < 0
        quats[frame, flip] *= -1
    samplers: list[dict[str, object]] = []
    channels: list[dict[str, object]] = []
    tracks = [(joint, "rotation", quats[:, joint]) for joint in range(len(JOINTS))]
    tracks.append((0, "translation", poses.translation + root))
    for node, path, values in tracks:
        output = glb.array(values.astype(np.float32), target=None)
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    return {"name": "motion", "samplers": samplers, "channels": channels}


def _normals(vertices: NDArray[np.floating], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """(V, 3) unit; up for a vertex without a face, since glTF knows no normal of zero length."""
    normals = vertex_normals(vertices, faces)
    normals[~normals.any(axis=1)] = (0.0, 1.0, 0.0)
    return normals


def _translations(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(J, 4, 4) that move the origin to `points` (J, 3)."""
    matrices = np.tile(np.eye(4), (len(points), 1, 1))
    matrices[:, :3, 3] = points
    return matrices
