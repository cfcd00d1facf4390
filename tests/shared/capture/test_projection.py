from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from stages.shared.capture import Take, open_capture
from stages.shared.capture.projection import project_colors, project_labels, sample_bilinear, visibility
from stages.shared.meshes import RayScene, load_mesh, vertex_normals
from tests.shared.capture import scene


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Take:
    return open_capture(scene.write_native(tmp_path_factory.mktemp("projection") / "ball", frames=1)).takes[0]


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=scene.RADIUS)
    mesh.apply_translation(scene.CENTRE)
    return mesh


def normals_of(points: np.ndarray) -> np.ndarray:
    return (points - scene.CENTRE) / scene.RADIUS


def test_colors_of_the_ball_come_back(take: Take, ball: trimesh.Trimesh) -> None:
    """A shift by half a pixel would be 8 levels of 255 here; what is asked for is a quarter of that."""
    points = ball.vertices
    colors, confidence = project_colors(points, normals_of(points), RayScene(points, ball.faces), take, 0)
    sure = confidence > 0.5
    assert sure.sum() > 0.4 * len(points)
    error = colors[sure] - scene.color_at(points[sure])
    assert np.abs(error.mean(axis=0)).max() < 0.004
    assert np.abs(error).max() < 0.03


def test_a_shift_of_half_a_pixel_would_be_seen(take: Take, ball: trimesh.Trimesh) -> None:
    """The bound above means something: the same with points half a pixel aside fails it."""
    points = ball.vertices
    aside = points + [0.5 * 1.7 / 70, 0, 0]
    colors, confidence = project_colors(
        aside, normals_of(points), RayScene(aside, ball.faces), take, 0, ["cam0"]
    )
    sure = confidence > 0.5
    assert np.abs((colors[sure] - scene.color_at(points[sure])).mean(axis=0)).max() > 0.008


def test_labels_are_voted(take: Take, ball: trimesh.Trimesh) -> None:
    points = ball.vertices
    votes = project_labels(points, normals_of(points), RayScene(points, ball.faces), take, 0)
    seen = votes.sum(axis=1) > 0
    away = np.abs(points[:, 1] - scene.CENTRE[1]) > 0.03  # a pixel is 0.025 m
    expected = scene.label_at(points)
    assert (seen & away).sum() > 0.6 * len(points)
    assert (votes.argmax(axis=1)[seen & away] == expected[seen & away]).all()


def test_what_faces_away_or_is_hidden_is_not_seen(take: Take, ball: trimesh.Trimesh) -> None:
    camera = take.cameras["cam0"]  # on +z
    points = ball.vertices
    sight = visibility(points, normals_of(points), camera, RayScene(points, ball.faces))
    towards = camera.centre - points
    facing = np.einsum("nk,nk->n", towards, normals_of(points)) > 0.02
    np.testing.assert_array_equal(
        sight.visible[np.abs(points[:, 2]) > 0.12], facing[np.abs(points[:, 2]) > 0.12]
    )
    wall = trimesh.creation.box(extents=[0.3, 0.3, 0.02])
    wall.apply_translation([0, 1, 0.8])
    both = trimesh.util.concatenate([ball, wall])
    hidden = visibility(points, normals_of(points), camera, RayScene(both.vertices, both.faces))
    assert hidden.visible.sum() < sight.visible.sum()
    middle = (np.abs(points[:, :2] - scene.CENTRE[:2]) < 0.1).all(axis=1)
    assert not hidden.visible[middle].any()


def test_the_layer_below_is_hidden_by_a_near_layer(take: Take) -> None:
    """A body 5 mm under cloth takes no colour from it."""
    inner = trimesh.creation.icosphere(subdivisions=4, radius=scene.RADIUS - 0.005)
    outer = trimesh.creation.icosphere(subdivisions=4, radius=scene.RADIUS)
    for mesh in (inner, outer):
        mesh.apply_translation(scene.CENTRE)
    both = trimesh.util.concatenate([inner, outer])
    colors, confidence = project_colors(
        inner.vertices, inner.vertex_normals, RayScene(both.vertices, both.faces), take, 0
    )
    assert not confidence.any() and not colors.any()


def test_silhouettes_count_little(take: Take, ball: trimesh.Trimesh) -> None:
    """Black background does not bleed into points at the rim."""
    points = ball.vertices
    colors, confidence = project_colors(points, normals_of(points), RayScene(points, ball.faces), take, 0)
    seen = confidence > 0.02
    dark = colors[seen].mean(axis=1) < scene.color_at(points[seen]).mean(axis=1) - 0.15
    assert dark.mean() < 0.002


def test_bilinear_samples_are_exact_at_centres_and_linear_between() -> None:
    image = np.array([[[0.0], [10.0]], [[20.0], [30.0]]], np.float32)
    values = sample_bilinear(image, np.array([[0.5, 0.5], [1.5, 0.5], [1.0, 1.0], [0.75, 1.5], [-3.0, -3.0]]))
    np.testing.assert_allclose(values[:, 0], [0, 10, 15, 22.5, 0])


def test_real_scan_gets_its_labels_and_colors(subject_a: Path) -> None:
    take = open_capture(subject_a).takes[0]
    assert take.scan is not None
    mesh = load_mesh(take.scan)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    occluder = RayScene(mesh.vertices, mesh.faces)
    votes = project_labels(mesh.vertices, normals, occluder, take, 0)
    seen = votes.sum(axis=1) > 0
    assert (votes.argmax(axis=1) == mesh.labels)[seen].mean() > 0.97
    colors, _ = project_colors(mesh.vertices, normals, occluder, take, 0)
    hits = occluder.render(take.cameras["Cam009"])
    truth = take.image("Cam009", 0) / 255.0
    inside = (take.mask("Cam009", 0) > 127) & hits.hit
    error = ((hits.interpolate(mesh.faces, colors) - truth)[inside] ** 2).mean()
    assert -10 * np.log10(error) > 19.0  # 19.6 measured; the albedo of the scan gives 16.8
