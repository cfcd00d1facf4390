from __future__ import annotations

import numpy as np
import pytest
import trimesh

from stages.shared.capture.camera import Camera
from stages.shared.meshes import RayScene
from tests.shared.capture import scene


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=scene.RADIUS)
    mesh.apply_translation(scene.CENTRE)
    return mesh


@pytest.fixture(scope="module")
def rays(ball: trimesh.Trimesh) -> RayScene:
    return RayScene(ball.vertices, ball.faces)


def test_render_agrees_with_the_formula_of_a_sphere(rays: RayScene, ball: trimesh.Trimesh) -> None:
    for camera in scene.ring(3):
        hits = rays.render(camera)
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        points, hit = scene.ball_points(camera, columns, rows)
        assert (hits.hit != hit).sum() <= 4  # pixels on the rim of a polyhedron
        both = hits.hit & hit
        depth = camera.project(points)[1]
        assert np.abs(hits.distance - depth)[both].max() < 0.01
        assert np.abs(hits.distance - depth)[both].mean() < 2e-4
        assert np.isinf(hits.distance[~hits.hit]).all() and (hits.face[~hits.hit] == -1).all()
        found = hits.interpolate(ball.faces, ball.vertices)
        assert np.abs(found - points)[both].mean() < 2e-4


def test_a_centred_disc_is_symmetric(ball: trimesh.Trimesh, rays: RayScene) -> None:
    """Pixel centres at integer + 0.5: the silhouette of a ball on the axis is the same upside down."""
    for width, height in ((64, 48), (63, 47)):
        camera = scene.ring(1, width, height)[0]
        intrinsics = np.array([[70.0, 0, width / 2], [0, 70.0, height / 2], [0, 0, 1]])
        mask = rays.render(Camera("c", width, height, intrinsics, camera.camera_from_world)).hit
        assert mask.sum() > 400
        # A few rim pixels may fall to either side of the polyhedron's edge.
        assert (mask != mask[::-1, ::-1]).sum() <= 2
        rows, columns = np.nonzero(mask)
        assert columns.mean() + 0.5 == pytest.approx(width / 2, abs=0.02)
        assert rows.mean() + 0.5 == pytest.approx(height / 2, abs=0.02)


def test_orthographic_front_and_back_share_columns() -> None:
    """A bump at +x on the front: seen at +x from both sides, nearer from the front."""
    plate = trimesh.creation.box(extents=[1, 1, 0.1])
    bump = trimesh.creation.box(extents=[0.2, 0.2, 0.2])
    bump.apply_translation([0.3, 0.2, 0.1])
    both = trimesh.util.concatenate([plate, bump])
    rays = RayScene(both.vertices, both.faces)
    x, y = np.linspace(-0.59, 0.59, 60), np.linspace(0.59, -0.59, 60)  # rows go down
    front = rays.orthographic(x, y)
    assert np.argwhere(front.hit).min(axis=0).tolist() == [5, 5] and front.hit.sum() == 50 * 50
    z = front.interpolate(both.faces, both.vertices)[..., 2]
    rows, columns = np.nonzero(front.hit & (z > 0.1))
    assert x[columns].mean() == pytest.approx(0.3, abs=1e-6) and y[rows].mean() == pytest.approx(
        0.2, abs=1e-6
    )
    back = rays.orthographic(x, y, back=True)
    assert back.hit.sum() == front.hit.sum()
    z = back.interpolate(both.faces, both.vertices)[..., 2]
    np.testing.assert_allclose(z[back.hit], -0.05, atol=1e-5)
    assert front.distance[front.hit].min() == pytest.approx(1.0, abs=1e-5)


def test_distances_against_the_formula(rays: RayScene) -> None:
    points = scene.CENTRE + np.random.default_rng(0).normal(0, 0.4, (200, 3))
    expected = np.linalg.norm(points - scene.CENTRE, axis=1) - scene.RADIUS
    np.testing.assert_allclose(rays.signed_distance(points), expected, atol=1e-3)
    np.testing.assert_allclose(rays.distance(points), np.abs(expected), atol=1e-3)


def test_closest_points_are_on_their_faces(rays: RayScene, ball: trimesh.Trimesh) -> None:
    points = scene.CENTRE + np.random.default_rng(1).normal(0, 0.4, (100, 3))
    closest, face, barycentric = rays.closest(points)
    again = np.einsum("nk,nkc->nc", barycentric, ball.vertices[ball.faces[face]])
    np.testing.assert_allclose(again, closest, atol=1e-5)
    np.testing.assert_allclose(
        np.linalg.norm(points - closest, axis=1),
        np.abs(np.linalg.norm(points - scene.CENTRE, axis=1) - 0.4),
        atol=1e-3,
    )


def test_nearest_corner_keeps_labels_whole(rays: RayScene, ball: trimesh.Trimesh) -> None:
    labels = scene.label_at(ball.vertices)
    hits = rays.render(scene.ring(1)[0])
    found = hits.largest_corner(ball.faces, labels, outside=255)
    assert set(np.unique(found)) == {3, 4, 255}
    assert (found[~hits.hit] == 255).all()
    rows = np.nonzero(found == 3)[0]
    assert rows.max() <= np.nonzero(found == 4)[0].min()


def test_points_on_the_surface_do_not_hide_themselves(rays: RayScene, ball: trimesh.Trimesh) -> None:
    camera = scene.ring(1)[0]
    near = ball.vertices[:, 2] > 0.15
    assert not rays.occluded(camera.centre, ball.vertices[near], 0.002).any()
    far = ball.vertices[:, 2] < -0.15
    assert rays.occluded(camera.centre, ball.vertices[far], 0.002).all()
