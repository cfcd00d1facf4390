"""A skinned template posed by the rules of glTF lands where the body model puts it."""

from __future__ import annotations

import json
from dataclasses import replace
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
from stages.shared.export.texture import mesh_texture
from tests.shared.export.validator import gltf_validator_report
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


@pytest.fixture(scope="module")
def textured(mesh: SkinnedMesh) -> SkinnedMesh:
    """The mesh with a texture whose colours say where each texel is."""
    maps = worn("upper").maps
    return replace(
        mesh, texture=mesh_texture(maps, place_colors(maps.positions.numpy()), mesh.vertices, mesh.faces)
    )


def place_colors(points: np.ndarray) -> np.ndarray:
    """(N, 3) colours 0..1 that change slowly and differ between front and back."""
    low, high = np.array([-0.6, -1.0, -0.3]), np.array([0.6, 1.0, 0.3])
    return np.clip((points - low) / (high - low), 0, 1)


def test_the_texture_shows_every_place_its_own_texel(textured: SkinnedMesh, tmp_path: Path) -> None:
    """Another reader samples the texture at its UVs and gets the colour of that place of the surface."""
    write_skinned_glb(tmp_path / "a.glb", textured, embedded_body(), np.zeros(10, np.float32))
    loaded = trimesh.load_scene(tmp_path / "a.glb").to_mesh()
    assert len(loaded.faces) == len(textured.faces)
    picture = loaded.visual.material.baseColorTexture
    triangles, uvs = loaded.vertices[loaded.faces].mean(axis=1), loaded.visual.uv[loaded.faces].mean(axis=1)
    seen = np.asarray(picture)[
        ((1 - uvs[:, 1]) * picture.height).astype(int), (uvs[:, 0] * picture.width).astype(int)
    ]
    errors = np.abs(seen / 255.0 - place_colors(triangles)).max(axis=1)
    assert np.quantile(errors, 0.99) < 0.03 and (errors < 0.2).all()


def test_seams_double_vertices_and_not_normals(textured: SkinnedMesh, tmp_path: Path) -> None:
    texture = textured.texture
    assert texture is not None and len(texture.vertex) >= len(np.unique(textured.faces))
    np.testing.assert_array_equal(texture.vertex[texture.faces], textured.faces)
    write_skinned_glb(tmp_path / "a.glb", textured, embedded_body(), BETAS)
    write_skinned_glb(tmp_path / "b.glb", replace(textured, texture=None), embedded_body(), BETAS)
    with_uvs, without = (
        {
            name: glb.array(accessor)
            for name, accessor in glb.content["meshes"][0]["primitives"][0]["attributes"].items()
        }
        for glb in (GlbReader(tmp_path / "a.glb"), GlbReader(tmp_path / "b.glb"))
    )
    for name in ("POSITION", "NORMAL", "WEIGHTS_0", "JOINTS_1"):
        np.testing.assert_array_equal(with_uvs[name], without[name][texture.vertex])
    assert "COLOR_0" not in with_uvs and "TEXCOORD_0" not in without


def test_four_weights_on_request(mesh: SkinnedMesh, tmp_path: Path) -> None:
    write_skinned_glb(tmp_path / "a.glb", mesh, embedded_body(), BETAS, weights_per_vertex=4)
    glb = GlbReader(tmp_path / "a.glb")
    fields = glb.content["meshes"][0]["primitives"][0]["attributes"]
    assert "JOINTS_1" not in fields and "WEIGHTS_1" not in fields
    np.testing.assert_allclose(glb.array(fields["WEIGHTS_0"]).sum(axis=1), 1, atol=1e-6)


def test_the_validator_of_khronos_finds_no_error(textured: SkinnedMesh, dance: Poses, tmp_path: Path) -> None:
    write_skinned_glb(tmp_path / "a.glb", textured, embedded_body(), BETAS, dance)
    report = gltf_validator_report(tmp_path / "a.glb")
    assert report["issues"]["numErrors"] == 0 and report["issues"]["numWarnings"] == 0, report["issues"]
