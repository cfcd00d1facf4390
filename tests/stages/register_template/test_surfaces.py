"""Frame choice, hull, remeshing and the fit of the body to a mesh, each against a known answer."""

from __future__ import annotations

import numpy as np
import pytest

from stages.register_template.frame_choice import choose_frame, openness
from stages.register_template.hull import carve, largest_part, outward, smooth
from stages.register_template.silhouettes import fewest_views, hull_field, silhouette
from stages.shared.body import embedded_body
from stages.shared.capture.take import Take
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.remesh import remesh, simplify
from stages.shared.report import SILENT
from tests.shared.capture import scene

from .scenes import a_pose


class BallTake(Take):
    """A take whose masks are those of a ball; nothing is on disk."""

    def mask(self, camera: object, frame: int) -> np.ndarray:
        return scene.picture(self.camera(camera))[1]  # type: ignore[arg-type]


def ball_take(count: int) -> BallTake:
    cameras = {camera.name: camera for camera in scene.ring(count, 256, 192, 280.0)}
    views = {(name, 0): None for name in cameras}
    return BallTake("ball", "train", cameras, tuple(cameras), (), [0], scene.poses(1), views)  # type: ignore[arg-type]


def volume(mesh: Mesh) -> float:
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    return float(np.einsum("fk,fk->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def sphere(radius: float = 0.3, centre: float = 0.0) -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return Mesh(np.asarray(ball.vertices, np.float32) + np.float32(centre), np.asarray(ball.faces, np.int32))


def test_open_arms_win_and_closed_ones_lose() -> None:
    body, poses = embedded_body(), a_pose(4)
    scores = openness(body, poses)
    assert scores.argmax() == 1
    assert choose_frame(body, poses, [0, 1, 2, 3]) == 1
    assert choose_frame(body, poses, [0, 2, 3]) in (2, 3)


def test_hull_of_a_ball_is_the_ball_and_a_little_more() -> None:
    points = sphere(0.32).vertices + scene.CENTRE  # the body in there
    hull = carve(ball_take(8), 0, points, 0.02, 0.6, SILENT)
    distance = np.linalg.norm(hull.vertices - scene.CENTRE, axis=1)
    assert distance.min() > 0.985 * scene.RADIUS  # a hull contains the shape, up to a fraction of a pixel
    level = np.abs(hull.vertices[:, 1] - scene.CENTRE[1]) < 0.02
    assert distance[level].max() < 1.12 * scene.RADIUS  # eight views leave an octagon around the equator
    ball = 4 / 3 * np.pi * scene.RADIUS**3
    assert ball < volume(hull) < 1.35 * ball  # positive: faces point outward


def test_a_hull_is_rounded_between_its_views() -> None:
    body = sphere(0.8 * scene.RADIUS)
    points = (body.vertices + scene.CENTRE).astype(np.float64)
    plain = carve(ball_take(8), 0, points, 0.02, 0.6, SILENT)
    rounded = carve(ball_take(8), 0, points, 0.02, 0.6, SILENT, body.faces)
    off = [
        np.abs(np.linalg.norm(hull.vertices - scene.CENTRE, axis=1) / scene.RADIUS - 1).mean()
        for hull in (plain, rounded)
    ]
    assert off[1] < 0.6 * off[0]


def test_space_that_no_camera_sees_is_outside() -> None:
    """Cameras so near that each sees little more than the ball: around it there is no evidence."""
    from stages.register_template.fitting.rough_hull import rough_hull

    take = ball_take(8)
    mesh = rough_hull(take, 0)
    assert np.ptp(mesh.vertices, axis=0).max() < 2.4 * scene.RADIUS
    points = scene.CENTRE + np.random.default_rng(0).uniform(-6.0, 6.0, (4000, 3))
    silhouettes = [silhouette(take, name, 0) for name in take.training_cameras]
    views = sum(one.camera.in_view(one.camera.project(points)[0]).astype(int) for one in silhouettes)
    assert (views < fewest_views(8)).any()
    assert (hull_field(points, silhouettes, 0.1)[views < fewest_views(8)] == -0.1).all()


@pytest.mark.parametrize(("cameras", "views"), [(2, 2), (4, 2), (8, 4), (20, 4), (160, 4)])
def test_how_many_views_are_enough(cameras: int, views: int) -> None:
    assert fewest_views(cameras) == views


def test_hull_needs_three_cameras() -> None:
    with pytest.raises(BadData, match="2 cameras"):
        carve(ball_take(2), 0, scene.CENTRE + np.eye(3) * 0.1, 0.02, 0.6, SILENT)


def test_smoothing_takes_noise_away_and_keeps_the_size() -> None:
    ball = sphere()
    noisy = Mesh(ball.vertices + np.random.default_rng(1).normal(0, 0.004, ball.vertices.shape), ball.faces)
    smoothed = smooth(noisy, 8)
    radius = np.linalg.norm(smoothed.vertices, axis=1)
    assert radius.std() < 0.6 * np.linalg.norm(noisy.vertices, axis=1).std()
    assert abs(radius.mean() - 0.3) < 0.002


def test_largest_part_and_orientation() -> None:
    big, small = sphere(0.3), sphere(0.05, 1.0)
    vertices = np.concatenate([small.vertices[:80], big.vertices])
    faces = np.concatenate([small.faces[(small.faces < 80).all(1)], big.faces + 80])
    part = largest_part(outward(vertices.astype(np.float64), faces[:, ::-1]))
    assert len(part.vertices) == len(big.vertices) and volume(part) > 0


@pytest.mark.parametrize("time_limit", [60.0, 0.001])
def test_remesh_and_its_fallback(time_limit: float) -> None:
    ball = sphere()
    labels = (ball.vertices[:, 1] > 0).astype(np.uint8)
    even, way = remesh(Mesh(ball.vertices, ball.faces, None, labels), 0.05, time_limit)
    assert way == ("pymeshlab" if time_limit > 1 else "libigl")
    assert abs(np.linalg.norm(even.vertices, axis=1).mean() - 0.3) < 0.005
    edges = even.vertices[even.faces] - even.vertices[np.roll(even.faces, -1, axis=1)]
    assert 0.035 < np.linalg.norm(edges, axis=-1).mean() < 0.075
    clear = np.abs(even.vertices[:, 1]) > 0.05
    assert np.array_equal(even.labels[clear], (even.vertices[clear, 1] > 0).astype(np.uint8))


def test_simplify_leaves_small_meshes_alone() -> None:
    ball = sphere()
    assert simplify(ball, 10_000) == (ball, "unchanged")
    fewer, _ = simplify(ball, 400)
    assert len(fewer.faces) <= 420
