"""Frame choice, hull, remeshing and the fit of the body to a mesh, each against a known answer."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from stages.register_template.fitting.bones import State
from stages.register_template.fitting.contours import views_of
from stages.register_template.fitting.fit_check import FitCheck
from stages.register_template.fitting.fit_views import Observation
from stages.register_template.frame_choice import choose_frame, openness
from stages.register_template.hull import carve, largest_part, outward, rough_hull, smooth
from stages.register_template.silhouettes import fewest_views, hull_field, silhouettes_of
from stages.shared.body import embedded_body
from stages.shared.capture.take import Take, ViewFiles
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.remesh import remesh, simplify
from stages.shared.report import SILENT
from tests.listening import Listener
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
    take = ball_take(8)
    mesh = rough_hull(take, 0, SILENT)
    assert np.ptp(mesh.vertices, axis=0).max() < 2.4 * scene.RADIUS
    points = scene.CENTRE + np.random.default_rng(0).uniform(-6.0, 6.0, (4000, 3))
    silhouettes = silhouettes_of(take, 0, 2, "a test", SILENT)
    views = sum(one.camera.in_view(one.camera.project(points)[0]).astype(int) for one in silhouettes)
    assert (views < fewest_views(8)).any()
    assert (hull_field(points, silhouettes, 0.1)[views < fewest_views(8)] == -0.1).all()


@pytest.mark.parametrize(("cameras", "views"), [(2, 2), (4, 2), (8, 4), (20, 4), (160, 4)])
def test_how_many_views_are_enough(cameras: int, views: int) -> None:
    assert fewest_views(cameras) == views


def test_hull_needs_three_cameras() -> None:
    with pytest.raises(BadData, match="2 cameras"):
        carve(ball_take(2), 0, scene.CENTRE + np.eye(3) * 0.1, 0.02, 0.6, SILENT)


class AbsentBallTake(BallTake):
    """The ball is outside of the view of the first camera."""

    def mask(self, camera: object, frame: int) -> np.ndarray:
        mask = super().mask(camera, frame)
        return np.zeros_like(mask) if camera == "cam0" else mask

    def view(self, camera: object, frame: int) -> ViewFiles:
        return ViewFiles(Path("image.png"), Path("mask.png"))


def test_a_view_that_shows_nobody_costs_that_view_only() -> None:
    whole, heard = ball_take(8), Listener()
    take = AbsentBallTake(**{part.name: getattr(whole, part.name) for part in fields(Take)})
    body = (sphere(0.8 * scene.RADIUS).vertices + scene.CENTRE).astype(np.float64)
    hull = carve(take, 0, body, 0.02, 0.6, heard)
    assert np.linalg.norm(hull.vertices - scene.CENTRE, axis=1).max() < 1.3 * scene.RADIUS
    assert len(heard.warnings) == 1 and "frame 0" in heard.warnings[0] and "cam0" in heard.warnings[0]
    assert [view.camera.name for view in views_of(take, 0)] == [f"cam{number}" for number in range(1, 8)]
    check = FitCheck(take)
    state = State.of(take.poses[0])
    check.add(embedded_body(), 0, state, Observation(views_of(take, 0)))
    check.judge(np.zeros(10), heard)
    assert "cam0 in 1 frames, the first is 0" in heard.warnings[1]
    with pytest.raises(BadData, match=r"Only 2 cameras.*a hull needs 3"):
        few = ball_take(3)
        carve(
            AbsentBallTake(**{part.name: getattr(few, part.name) for part in fields(Take)}),
            0, body, 0.02, 0.6, SILENT,
        )  # fmt: skip


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
