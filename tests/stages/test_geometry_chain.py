"""register-template → canonicalize → segment-layers → bake-maps on a dressed body with known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.bake_maps import stage as bake_maps
from stages.bake_maps.config import PRESETS as BAKE
from stages.canonicalize import stage as canonicalize
from stages.canonicalize.config import PRESETS as CANONICALIZE
from stages.canonicalize.shape import add_shape
from stages.canonicalize.unpose import forward_skin
from stages.register_template import stage as register_template
from stages.register_template.config import PRESETS as REGISTER
from stages.segment_layers import stage as segment_layers
from stages.segment_layers.config import PRESETS as SEGMENT
from stages.shared.artifacts import Artifact
from stages.shared.body.canonical import posed_from_canonical
from stages.shared.body.load import embedded_body
from stages.shared.errors import BadData, MissingInput
from stages.shared.layers import LABELS
from stages.shared.meshes.load import write_ply
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene
from tests.stages.dressed_body import COLORS, LOWER, SKIN, UPPER, Dressed, dressed, write_capture


@pytest.fixture(scope="module")
def person() -> Dressed:
    return dressed()


@pytest.fixture(scope="module")
def from_capture(person: Dressed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A subject made from images, masks and label images; all four stages done."""
    folder = tmp_path_factory.mktemp("capture_chain")
    capture = write_capture(folder / "capture", person)
    register_template.run(capture, folder / "subject", REGISTER["tiny"])
    return chain(folder / "subject")


@pytest.fixture(scope="module")
def from_mesh(person: Dressed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A subject made from a lone labelled mesh and its parameters; all four stages done."""
    folder = tmp_path_factory.mktemp("mesh_chain")
    write_ply(folder / "person.ply", person.mesh)
    (folder / "person.npz").write_bytes(person.poses.to_npz_bytes())
    register_template.run(
        folder / "person.ply", folder / "subject", REGISTER["tiny"], params=folder / "person.npz"
    )
    return chain(folder / "subject")


def chain(subject: Path) -> Path:
    canonicalize.run(subject, CANONICALIZE["tiny"])
    segment_layers.run(subject, SEGMENT["tiny"])
    bake_maps.run(subject, BAKE["tiny"])
    return subject


def maps_of(subject: Path) -> Artifact:
    return bake_maps.run(subject, BAKE["tiny"]).artifact


def test_template_poses_back_exactly(from_capture: Path) -> None:
    summary = canonicalize.run(from_capture, CANONICALIZE["tiny"]).summary
    assert summary["residual_max_m"] < 1e-5
    assert summary["requeried_residual_p95_m"] < 3e-3
    assert summary["blended_inverse_vertices"] == 0


def test_layers_are_those_worn_and_labels_are_right(from_capture: Path, person: Dressed) -> None:
    result = segment_layers.run(from_capture, SEGMENT["tiny"])
    assert result.summary["layers"] == ["body", "lower", "upper"]
    assert result.summary["labels_from"] == "images"
    found = result.artifact.arrays("labels")["labels"]
    assert (found == person.mesh.labels).mean() > 0.95


def test_scan_labels_serve_a_lone_mesh(from_mesh: Path, person: Dressed) -> None:
    result = segment_layers.run(from_mesh, SEGMENT["tiny"])
    assert result.summary["labels_from"] == "scan"
    assert (result.artifact.arrays("labels")["labels"] == person.mesh.labels).mean() > 0.98
    assert set(result.summary["area_shares"]) <= {LABELS[label] for label in range(5)}


@pytest.mark.parametrize("fixture", ["from_capture", "from_mesh"])
def test_texels_pose_back_onto_the_surface_they_came_from(
    fixture: str, person: Dressed, request: pytest.FixtureRequest
) -> None:
    artifact = maps_of(request.getfixturevalue(fixture))
    surface = RayScene(person.mesh.vertices, person.mesh.faces)
    pose = person.poses
    transforms = posed_from_canonical(
        embedded_body(),
        *(torch.as_tensor(v).double() for v in (pose.rotations[0], pose.translation[0], pose.betas)),
    ).numpy()
    for layer in ("upper", "lower"):
        maps = {name: values.astype(float) for name, values in artifact.arrays(layer).items()}
        shaped = add_shape(maps["positions"], maps["shape_directions"], pose.betas)
        distance = surface.distance(forward_skin(shaped, maps["skin_weights"], transforms))
        assert np.percentile(distance, 90) < 2e-3
        np.testing.assert_allclose(maps["skin_weights"].sum(axis=1), 1.0, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(maps["normals"], axis=1), 1.0, atol=1e-5)


def test_texel_colours_are_those_of_the_layer_also_where_no_camera_looked(from_capture: Path) -> None:
    artifact = maps_of(from_capture)
    for layer, label in (("upper", UPPER), ("lower", LOWER)):
        maps = artifact.arrays(layer)
        error = np.abs(maps["colors"] - COLORS[label] / 255).max(axis=1)
        assert np.percentile(error, 95) < 0.1
    body = artifact.arrays("body")
    skin = body["labels"] == SKIN
    covered = skin & (body["color_confidence"] == 0)
    assert covered.mean() > 0.2, "skin under clothes was never seen"
    error = np.abs(body["colors"][skin] - COLORS[SKIN] / 255).max(axis=1)
    assert np.percentile(error, 90) < 0.15


def test_maps_share_one_grid_and_are_up_to_date_when_asked_again(from_capture: Path, from_mesh: Path) -> None:
    first, second = maps_of(from_capture), maps_of(from_mesh)
    assert first.summary["centre"] == second.summary["centre"]
    assert first.summary["grid_size"] == 100
    assert maps_of(from_capture).path == first.path


def test_same_input_same_bytes(from_mesh: Path) -> None:
    first = {
        stage: run(from_mesh, presets["tiny"]).artifact.digest
        for stage, run, presets in (
            ("canonicalize", canonicalize.run, CANONICALIZE),
            ("segment-layers", segment_layers.run, SEGMENT),
            ("bake-maps", bake_maps.run, BAKE),
        )
    }
    for stage, run, presets in (
        ("canonicalize", canonicalize.run, CANONICALIZE),
        ("segment-layers", segment_layers.run, SEGMENT),
        ("bake-maps", bake_maps.run, BAKE),
    ):
        assert run(from_mesh, presets["tiny"], force=True).artifact.digest == first[stage]


def test_a_mesh_without_labels_is_told_what_is_missing(person: Dressed, tmp_path: Path) -> None:
    bare = Mesh(person.mesh.vertices, person.mesh.faces)
    write_ply(tmp_path / "bare.ply", bare)
    (tmp_path / "bare.npz").write_bytes(person.poses.to_npz_bytes())
    subject = tmp_path / "subject"
    register_template.run(tmp_path / "bare.ply", subject, REGISTER["tiny"], params=tmp_path / "bare.npz")
    canonicalize.run(subject, CANONICALIZE["tiny"])
    with pytest.raises(MissingInput, match="label"):
        segment_layers.run(subject, SEGMENT["tiny"])
    assert not (subject / "segment-layers").exists()


def test_a_grid_that_is_too_small_is_refused_and_leaves_nothing(from_mesh: Path) -> None:
    before = sorted(path.name for path in (from_mesh / "bake-maps").iterdir())
    with pytest.raises(BadData, match="--extent"):
        bake_maps.run(from_mesh, replace(BAKE["tiny"], extent_m=1.0))
    assert sorted(path.name for path in (from_mesh / "bake-maps").iterdir()) == before


def test_stages_say_which_command_is_missing(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match="register-template"):
        canonicalize.run(tmp_path / "nobody", CANONICALIZE["tiny"])


def test_plans_name_inputs_and_costs(from_capture: Path) -> None:
    for stage in (canonicalize, segment_layers, bake_maps):
        plan = stage.plan(from_capture)
        assert plan.inputs and plan.outputs and plan.seconds and plan.memory_bytes
        assert plan.config.get("picture_scale", [1.0, 1.0]) == [1.0, 1.0], "small pictures keep their size"
