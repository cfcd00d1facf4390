"""What following the garments solves, on input that says nothing, too much, or nonsense."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from stages.shared.avatar.maps import LayerMaps
from stages.shared.capture import Camera
from stages.shared.errors import BadData
from stages.train.config import TrackConfig
from stages.train.tracking.control_grid import ControlGrid, conjugate_gradient, fit_control_points
from stages.train.tracking.normal_equations import (
    Flow,
    NormalEquations,
    collision_equations,
    estimate_flow,
)
from stages.train.tracking.tracker import Tracker
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube_arrays

PER_METRE = 220.0
SIDE = 48
CAMERA = Camera("c", SIDE, SIDE, [[60.0, 0, 24], [0, 60, 24], [0, 0, 1]], np.eye(4))  # type: ignore[arg-type]


def tube(kept: int | None = None) -> LayerMaps:
    """A tube, or its first texels alone."""
    arrays = tube_arrays(0.15, -0.1, 0.1)
    if kept is not None:
        arrays = {name: a if name in ("window", "seams") else a[:kept] for name, a in arrays.items()}
        arrays["seams"] = arrays["seams"][:0]
        arrays["neighbours"] = np.where(arrays["neighbours"] < kept, arrays["neighbours"], -1)
    return LayerMaps.from_arrays("upper", arrays, PITCH, CENTRE, GRID)


def cells(maps: LayerMaps, size: tuple[int, int] = (4, 5)) -> ControlGrid:
    points = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (len(maps), 2)))
    return ControlGrid.of(maps, points, size)


def solved(
    equations: NormalEquations, followed: ControlGrid, found: np.ndarray | None = None, **weights: float
) -> np.ndarray:
    """One Gauss-Newton step from `found` cells (zero without), which is also where they rest."""
    start = np.zeros((len(followed.where), 3)) if found is None else found
    tracker: Any = SimpleNamespace(config=replace(TrackConfig(), **weights))  # type: ignore[arg-type]
    return Tracker._step(tracker, followed, equations, start, start)


@pytest.mark.parametrize("magnitude", [1e-200, 1e-30, 1e-9, 1.0, 1e9, 1e30, 1e200])
@pytest.mark.parametrize("stiffness", [1e-100, 1e-6, 1.0, 1e6, 1e100])
def test_a_system_of_any_size_is_solved(magnitude: float, stiffness: float) -> None:
    random = np.random.default_rng(0)
    root = random.normal(size=(12, 12))
    matrix, right = root @ root.T + np.eye(12), random.normal(size=(12, 3))
    found = conjugate_gradient(lambda x: stiffness * (matrix @ x), magnitude * right, 200)
    expected = np.linalg.solve(matrix, right) * (magnitude / stiffness)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_a_system_that_says_nothing_moves_nothing() -> None:
    """No equation, or no right side; and of a system that knows one direction of two, that one is solved."""
    ones = np.ones((4, 3))
    assert not conjugate_gradient(lambda x: 0.0 * x, ones, 60).any()
    assert not conjugate_gradient(lambda x: 2.0 * x, 0.0 * ones, 60).any()
    known = np.array([[1.0], [1.0], [0.0], [0.0]])
    found = conjugate_gradient(lambda x: known * x, known * ones, 60)
    np.testing.assert_allclose(found, known * ones, atol=1e-12)
    assert conjugate_gradient(lambda x: x, np.zeros((0, 3)), 60).shape == (0, 3)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_right_side_that_is_no_number_is_refused(value: float) -> None:
    right = np.ones((5, 3))
    right[3, 1] = value
    with pytest.raises(BadData, match=r"right\[3\]\[1\]"):
        conjugate_gradient(lambda x: x, right, 60)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_matrix_that_is_no_number_is_refused(value: float) -> None:
    with pytest.raises(BadData, match="conjugate_gradient"):
        conjugate_gradient(lambda x: value * x, np.ones((5, 3)), 60)


@pytest.mark.parametrize("texels", [0, 1, 2, None])
@pytest.mark.parametrize("size", [(1, 1), (1, 6), (4, 5)])
def test_layers_of_hardly_any_texel_have_cells(texels: int | None, size: tuple[int, int]) -> None:
    """Texels follow cells by weights that sum to one, and nothing pulls at a layer that moves as one."""
    maps = tube(texels)
    followed = cells(maps, size)
    count = len(followed.where)
    assert (count == 0) == (len(maps) == 0) and count <= 2 * size[0] * size[1]
    np.testing.assert_allclose(followed.basis @ np.ones(count), np.ones(len(maps)), atol=1e-9)
    for form in (followed.bending, followed.stretch):
        assert form.shape == (count, count) and np.abs(form @ np.ones((count, 3))).max(initial=0) < 1e-9
    shift = np.tile([[0.01, -0.02, 0.03]], (len(maps), 1))
    np.testing.assert_allclose(fit_control_points(followed, shift), shift[:1].repeat(count, 0), atol=1e-5)
    step = solved(NormalEquations.zero(len(maps)), followed)
    assert step.shape == (count, 3) and not step.any()


@pytest.mark.parametrize("weights", [{}, {"inertia": 0.0}, {"inertia": 0.0, "bending": 0.0, "stretch": 0.0}])
def test_where_nothing_is_seen_cloth_keeps_together(weights: dict[str, float]) -> None:
    """A layer out of sight that was carried off as one stays; nothing is made of no equation at all."""
    followed = cells(tube())
    carried = np.tile([[0.05, 0.0, -0.05]], (len(followed.where), 1))
    step = solved(NormalEquations.zero(followed.basis.shape[0]), followed, carried, **weights)
    assert np.abs(step).max() < 1e-5


@pytest.mark.parametrize("pixels", [1e-9, 1.0, 1e3, 1e12])
@pytest.mark.parametrize("trusted", [1.0, 1e-12])
def test_flow_of_any_size_gives_a_finite_step(pixels: float, trusted: float) -> None:
    maps = tube()
    equations = NormalEquations.zero(len(maps))
    random = np.random.default_rng(0)
    equations.matrix[:] = trusted * np.eye(3)
    equations.right[:] = trusted * pixels * random.normal(size=(len(maps), 3))
    step = solved(equations, cells(maps))
    assert np.isfinite(step).all()
    assert np.abs(step).max() <= 4 * pixels / PER_METRE, "never farther than what was seen"


@pytest.mark.parametrize("metres", [0.0, 1e-300, 1e-30, 1e-3, 1.0, 1e6, 1e30, 1e200])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_texels_anywhere_before_or_behind_a_camera(metres: float, side: float) -> None:
    """On the camera, behind it, far away: equations are finite, and those that nobody sees stay zero."""
    random = np.random.default_rng(0)
    means = side * metres * (np.array([0.0, 0.0, 1.0]) + 0.1 * random.normal(size=(30, 3)))
    equations = NormalEquations.zero(30)
    depth = np.full((SIDE, SIDE), metres)
    whole = np.ones((SIDE, SIDE), bool)
    flow = np.ones((SIDE * SIDE, 2))
    seen = Flow(flow, np.ones(SIDE * SIDE), np.tile([[0.5, 0.1, 0.5]], (SIDE * SIDE, 1)))
    with np.errstate(over="ignore"):
        carried = np.tile(np.eye(3), (30, 1, 1))
        equations.add(means, carried, CAMERA, depth, whole, whole, seen, PER_METRE)
    assert np.isfinite(equations.matrix).all() and np.isfinite(equations.right).all()
    if side < 0 or metres < 1e-3:
        assert not equations.matrix.any() and not equations.right.any()
    if side > 0 and metres == 1.0:
        assert equations.matrix.any()


@pytest.mark.parametrize("flow", [np.nan, np.inf, 1e300, -1e300])
def test_flow_out_of_the_picture_counts_for_nothing(flow: float) -> None:
    """Also where the optical flow itself is no number: then it leads nowhere."""
    equations = NormalEquations.zero(1)
    whole = np.ones((SIDE, SIDE), bool)
    seen = Flow(
        np.full((SIDE * SIDE, 2), flow), np.ones(SIDE * SIDE), np.tile([[0.5, 0.0, 0.5]], (SIDE * SIDE, 1))
    )
    means = np.array([[0.0, 0.0, 1.0]])
    equations.add(means, np.eye(3)[None], CAMERA, np.ones((SIDE, SIDE)), whole, whole, seen, PER_METRE)
    assert not equations.matrix.any() and not equations.right.any()


@pytest.mark.parametrize("kind", ["black", "white", "noise", "one point", "an edge"])
def test_pictures_with_little_in_them(kind: str) -> None:
    random = np.random.default_rng(0)
    picture = np.zeros((SIDE, SIDE), np.uint8)
    if kind == "white":
        picture[:] = 255
    elif kind == "noise":
        picture[:] = random.integers(0, 256, picture.shape)
    elif kind == "one point":
        picture[20, 20] = 255
    elif kind == "an edge":
        picture[:, SIDE // 2 :] = 255
    for other in (picture, np.roll(picture, 3, axis=1), np.zeros_like(picture), 255 - picture):
        found = estimate_flow(picture, other, True)
        assert found is not None
        for values in (found.vectors, found.trust, found.tensor):
            assert np.isfinite(values).all()
        assert found.trust.min() >= 0 and found.trust.max() <= 1
        assert (found.tensor[:, 0] + found.tensor[:, 2]).max() <= 1 + 1e-6
    assert estimate_flow(picture[:31], picture[:31], True) is None


@pytest.mark.parametrize("count", [0, 1, 3, 4, 50])
@pytest.mark.parametrize("kind", ["at one place", "normals of no length", "all directions", "far away"])
def test_bodies_of_any_kind_beneath_cloth(count: int, kind: str) -> None:
    """Cloth is led out where a body says where out is, never by more than reach and clearance."""
    random = np.random.default_rng(0)
    places = np.zeros((count, 3)) if kind == "at one place" else 0.01 * random.normal(size=(count, 3))
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    if kind == "normals of no length":
        normals[:] = 0
    elif kind == "all directions":
        normals = random.normal(size=(count, 3))
    elif kind == "far away":
        places += 1e6
    body: Any = SimpleNamespace(means=torch.from_numpy(places), normals=torch.from_numpy(normals))
    means = torch.from_numpy(0.01 * random.normal(size=(20, 3)))
    matrix, right = collision_equations(means, body, np.tile(np.eye(3), (20, 1, 1)), PER_METRE)
    assert np.isfinite(matrix).all() and np.isfinite(right).all()
    assert np.abs(right).max() <= (0.05 + 0.004) * PER_METRE
    led = right.any(axis=1)
    assert led.any() == (kind == "at one place" and count >= 4) or kind == "all directions"
    assert not led.any() or (np.linalg.eigvalsh(matrix[led]) >= -1e-12).all()
