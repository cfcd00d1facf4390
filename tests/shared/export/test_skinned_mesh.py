"""A skinned template posed by the rules of glTF lands where the body model puts it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from stages.shared.body import JOINTS, Poses, blend, embedded_body, posed_from_canonical
from stages.shared.export.glb import GlbReader
from stages.shared.export.notes import write_notes
from stages.shared.export.skinned_mesh import SkinnedMesh, strongest_weights, write_skinned_glb
from tests.shared.outfit.wardrobe import tube_mesh, worn

BETAS = np.array([1.5, -1, 0.5, 0, 0, 0, 0, 0, 0, 2], np.float32)


@pytest.fixture(scope="module")
def mesh() -> SkinnedMesh:
    arrays = tube_mesh(worn("upper"))
    names = ("vertices", "faces", "skin_weights", "shape_directions", "colors")
    return SkinnedMesh("upper", *(arrays[name] for name in names))


@pytest.fixture(scope="module")
def dance() -> Poses:
    rotations = np.random.default_rng(3).normal(0, 0.6, (4, 55, 3)).astype(np.float32)
    moved = np.random.default_rng(4).normal(0, 1, (4, 3)).astype(np.float32)
    return Poses(rotations, moved, np.zeros(10, np.float32), np.zeros((4, 10), np.float32), 25.0)


def node_matrices(glb: GlbReader, rotations: np.ndarray | None, root: np.ndarray | None) -> np.ndarray:
    """(55, 4, 4) world from node by walking the tree, as a glTF viewer does."""
    nodes, world = glb.content["nodes"], np.tile(np.eye(4), (len(JOINTS), 1, 1))
    waiting = [(0, np.eye(4))]
    while waiting:
        index, above = waiting.pop()
        node, local = nodes[index], np.eye(4)
        turn = node.get("rotation", [0, 0, 0, 1]) if rotations is None else rotations[index]
        local[:3, :3] = Rotation.from_quat(turn).as_matrix()
        local[:3, 3] = node["translation"] if root is None or index else root
        world[index] = above @ local
        waiting += [(child, world[index]) for child in node.get("children", [])]
    return world


def skinned(glb: GlbReader, world: np.ndarray) -> np.ndarray:
    """(V, 3) as in the glTF specification, section 3.7.3.3."""
    fields = glb.content["meshes"][0]["primitives"][0]["attributes"]
    joints = np.concatenate([glb.array(fields[f"JOINTS_{i}"]) for i in (0, 1)], axis=1)
    weights = np.concatenate([glb.array(fields[f"WEIGHTS_{i}"]) for i in (0, 1)], axis=1)
    carried = world @ glb.array(glb.content["skins"][0]["inverseBindMatrices"])
    matrices = np.einsum("vk,vkij->vij", weights, carried[joints])
    positions = glb.array(fields["POSITION"])
    return np.einsum("vij,vj->vi", matrices[:, :3, :3], positions) + matrices[:, :3, 3]


def test_rests_in_the_canonical_pose(mesh: SkinnedMesh, tmp_path: Path) -> None:
    path = tmp_path / "upper.glb"
    write_skinned_glb(path, mesh, embedded_body(), BETAS)
    glb = GlbReader(path)
    assert [node["name"] for node in glb.content["nodes"]] == [*JOINTS, "upper"]
    shaped = mesh.vertices + np.einsum("b,vbk->vk", BETAS, mesh.shape_directions)
    np.testing.assert_allclose(skinned(glb, node_matrices(glb, None, None)), shaped, atol=2e-6)
    positions = glb.array(glb.content["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
    np.testing.assert_allclose(positions, shaped, atol=1e-6)


def test_the_animation_is_the_body_models_skinning(mesh: SkinnedMesh, dance: Poses, tmp_path: Path) -> None:
    path, body = tmp_path / "upper.glb", embedded_body()
    write_skinned_glb(path, mesh, body, BETAS, dance)
    glb = GlbReader(path)
    (animation,) = glb.content["animations"]
    shaped = torch.from_numpy(mesh.vertices + np.einsum("b,vbk->vk", BETAS, mesh.shape_directions))
    joints, weights = strongest_weights(mesh.skin_weights)
    kept = np.zeros_like(mesh.skin_weights)
    np.add.at(kept, (np.arange(len(kept))[:, None], joints), weights)
    times = glb.array(animation["samplers"][0]["input"])
    np.testing.assert_allclose(times, [0, 0.04, 0.08, 0.12], atol=1e-7)
    for frame in range(len(dance)):
        rotations, root = np.zeros((len(JOINTS), 4)), None
        for channel in animation["channels"]:
            value = glb.array(animation["samplers"][channel["sampler"]]["output"])[frame]
            if channel["target"]["path"] == "rotation":
                rotations[channel["target"]["node"]] = value
            else:
                root = value
        moved = posed_from_canonical(
            body, torch.from_numpy(dance.rotations[frame]), torch.from_numpy(dance.translation[frame]),
            torch.from_numpy(BETAS),
        )  # fmt: skip
        matrices = blend(torch.from_numpy(kept), moved).numpy()
        wanted = np.einsum("vij,vj->vi", matrices[:, :3, :3], shaped.numpy()) + matrices[:, :3, 3]
        np.testing.assert_allclose(skinned(glb, node_matrices(glb, rotations, root)), wanted, atol=2e-5)


def test_another_reader_gets_the_mesh(mesh: SkinnedMesh, tmp_path: Path) -> None:
    write_skinned_glb(tmp_path / "upper.glb", mesh, embedded_body(), np.zeros(10, np.float32))
    loaded = trimesh.load_scene(tmp_path / "upper.glb").to_mesh()
    assert len(loaded.vertices) == len(mesh.vertices) and len(loaded.faces) == len(mesh.faces)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices, atol=1e-6)


def test_weights_are_the_strongest_and_sum_to_one() -> None:
    weights = np.zeros((2, 55), np.float32)
    weights[0, [3, 9]] = 0.25, 0.75
    weights[1, 10:30] = 0.05
    joints, kept = strongest_weights(weights)
    assert joints[0, :3].tolist() == [9, 3, 0] and kept[0, :3].tolist() == [0.75, 0.25, 0]
    np.testing.assert_allclose(kept.sum(axis=1), 1, atol=1e-6)
    assert (kept[1] == np.float32(0.125)).all()


def test_notes_say_frame_unit_and_colour(tmp_path: Path) -> None:
    for kind in ("ply", "spz", "glb", "mesh"):
        write_notes(tmp_path / f"{kind}.json", kind, "world", layers=["body"])
        notes = json.loads((tmp_path / f"{kind}.json").read_bytes())
        assert notes["frame"] == "world" and notes["unit"] == "metre" and notes["layers"] == ["body"]
        assert "+y up" in notes["axes"] and ("sRGB" in notes.get("color_space", "")) == (kind != "mesh")
