"""Peeled sheets: what neither view meets first gets texels, once, on the side it faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.bake_maps.config import BakeMapsConfig
from stages.bake_maps.peel import unseen_shares
from stages.bake_maps.stage import sheets_needed
from stages.bake_maps.texels import cast_texels
from stages.shared.plan import Plan
from stages.shared.texel_maps import neighbour_texels, seam_pairs, texel_numbers
from tests.stages.bake_maps.test_texels import RADIUS, grid, sphere

PITCH = 0.01


def plate(z: float, facing: int, half: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """A square across the z axis, facing the front (+1) or the back (−1)."""
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    quads = np.array([[0, 1, 2], [0, 2, 3]])
    return corners, quads if facing > 0 else quads[:, ::-1]


def joined(*meshes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes[:-1])])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def pleat(depth: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Cloth folded twice like a Z about a vertical line, closed behind by a flat back panel.

    From the front: a panel, its undersurface, a panel again, then the back.
    """
    across = np.concatenate([np.linspace(-0.2, 0.05, 26), np.linspace(0.05, -0.05, 11)[1:],
                             np.linspace(-0.05, 0.2, 26)[1:]])  # fmt: skip
    z = np.concatenate([np.full(26, depth), np.linspace(depth, 0.0, 11)[1:], np.zeros(25)])
    columns = len(across)
    vertices = np.concatenate([np.stack([across, np.full(columns, y), z], axis=1) for y in (-0.2, 0.2)])
    left = np.arange(columns - 1)
    faces = np.concatenate([
        np.stack([left, left + 1, left + 1 + columns], axis=1),
        np.stack([left, left + 1 + columns, left + columns], axis=1),
    ])  # fmt: skip
    return joined((vertices, faces), plate(-0.1, -1))


def test_a_hidden_ball_gets_one_texel_per_point_on_the_side_it_faces() -> None:
    vertices, faces = joined(plate(0.5, 1), sphere(radius=0.1), plate(-0.5, -1))
    texels = cast_texels(vertices, faces, grid(PITCH), "upper", sheets=3)
    positions = texels.interpolate(faces, vertices)
    peeled = texels.texels[:, 0] >= 2
    assert set(np.unique(texels.texels[:, 0])) == {0, 1, 2, 3}
    np.testing.assert_allclose(np.linalg.norm(positions[peeled], axis=1), 0.1, atol=1e-3)
    assert (positions[texels.texels[:, 0] == 2, 2] > -1e-3).all()
    assert (positions[texels.texels[:, 0] == 3, 2] < 1e-3).all()
    assert peeled.sum() == pytest.approx(2 * np.pi * 0.1**2 / PITCH**2, rel=0.05)
    normals = texels.outward(vertices, faces, vertices)
    assert (np.einsum("nk,nk->n", normals, positions)[peeled] > 0).all()


def test_enclosed_parts_stay_without_texels() -> None:
    vertices, faces = joined(sphere(), sphere(rings=24, radius=0.2))
    texels = cast_texels(vertices, faces, grid(PITCH), "body", sheets=4)
    np.testing.assert_allclose(np.linalg.norm(texels.interpolate(faces, vertices), axis=1), RADIUS, atol=2e-3)
    assert texels.views == 2


@pytest.mark.parametrize("depth", [0.06, 0.15])
def test_a_pleat_is_seen_whole_with_one_sheet(depth: float) -> None:
    vertices, faces = pleat(depth)
    shares = unseen_shares(vertices, faces)
    hidden = 2 * 0.1 * 0.4  # the upper panel hides as much of the lower one as of the undersurface
    slope = np.hypot(0.1, depth) * 0.4
    total = 0.25 * 0.4 + slope + 0.25 * 0.4 + 0.16
    assert shares[0] == pytest.approx((hidden / 2 + slope) / total, rel=0.03)
    assert shares[1] < 0.002
    assert sheets_needed(shares, BakeMapsConfig()) == 1
    assert sheets_needed(shares, BakeMapsConfig(most_sheets=0)) == 0
    assert sheets_needed(shares, BakeMapsConfig(unseen_limit=0.9)) == 0


def test_links_follow_the_cloth_beneath_and_seams_close_the_folds() -> None:
    vertices, faces = pleat(0.02)
    texels = cast_texels(vertices, faces, grid(PITCH), "upper", sheets=1)
    positions = texels.interpolate(faces, vertices)
    numbers = texel_numbers(texels.texels, texels.window, texels.views)
    neighbours = neighbour_texels(numbers, texels.texels, texels.window, positions[:, 2], 0.015)
    side = texels.texels[:, 0] % 2
    for direction in range(4):
        here = np.flatnonzero(neighbours[:, direction] >= 0)
        there = neighbours[here, direction]
        np.testing.assert_array_equal(side[here], side[there])
        np.testing.assert_array_equal(neighbours[there, (direction + 2) % 4], here)
        assert np.abs(positions[here, 2] - positions[there, 2]).max() <= 0.015
    lower = np.flatnonzero((side == 0) & (np.abs(positions[:, 2]) < 1e-4))
    across = neighbours[lower, 1]
    sheet = texels.texels[:, 0] // 2
    crossing = (across >= 0) & (sheet[lower] != sheet[across])
    assert crossing.sum() == 40, "every row of the lower panel goes on where it comes out from beneath"
    normals = texels.outward(vertices, faces, vertices)
    normals[:, 0] = np.where(np.abs(positions[:, 0] - 0.05) < 0.02, 1.0, -1.0)  # a soft crease turns sideways
    seams = seam_pairs(numbers, neighbours, positions, normals, 0.12, 0.03)
    assert (side[seams[:, 0]] == 0).all() and (side[seams[:, 1]] == 1).all()
    joins = texels.texels[seams[:, 1], 0] == 3
    assert joins.sum() >= 40 and np.ptp(positions[seams[joins, 0], 1]) > 0.35


def test_peeling_is_deterministic_and_leaves_the_first_hits_alone() -> None:
    vertices, faces = pleat()
    plain, peeled, again = (cast_texels(vertices, faces, grid(PITCH), "upper", k) for k in (0, 2, 2))
    first = peeled.texels[:, 0] < 2
    np.testing.assert_array_equal(peeled.texels[first], plain.texels)
    np.testing.assert_array_equal(peeled.face[first], plain.face)
    assert peeled.barycentric.tobytes() == again.barycentric.tobytes()
    keys = (peeled.texels[:, 0].astype(np.int64) * 1000 + peeled.texels[:, 1]) * 1000 + peeled.texels[:, 2]
    assert (np.diff(keys) > 0).all()


def test_the_command_limits_the_sheets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked = []
    monkeypatch.setattr("gw_cli.bake_maps.check_inputs_of", lambda *arguments: None)
    monkeypatch.setattr(
        "stages.bake_maps.stage.plan", lambda subject, config: asked.append(config) or Plan([], [])
    )
    runner = CliRunner()
    for words in ([], ["--sheets", "0"]):
        done = runner.invoke(app, ["bake-maps", str(tmp_path), "--dry-run", "--json", *words])
        assert done.exit_code == 0, done.stderr
    assert [config.most_sheets for config in asked] == [BakeMapsConfig().most_sheets, 0]
    assert runner.invoke(app, ["bake-maps", str(tmp_path), "--sheets", "99"]).exit_code == 2
