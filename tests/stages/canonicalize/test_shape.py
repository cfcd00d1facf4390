"""Shape removal: exact against direct computation with the other shape, and tear detection."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.canonicalize.shape import add_shape, canonical_body, template_shape_directions
from stages.canonicalize.unpose import cut_tears
from stages.shared.body.canonical import canonical_from_rest
from stages.shared.body.kinematics import shaped_vertices, skin
from stages.shared.body.load import embedded_body


def direct(betas: np.ndarray) -> np.ndarray:
    """Canonical vertices of a shape, by forward kinematics of that shape."""
    body, shape = embedded_body(), torch.as_tensor(betas)
    weights = torch.as_tensor(body.skin_weights, dtype=torch.float64)
    return skin(shaped_vertices(body, shape), weights, canonical_from_rest(body, shape)).numpy()


@pytest.mark.parametrize("seed", range(3))
def test_removing_one_shape_and_adding_another_is_exact(seed: int) -> None:
    first, second = np.random.default_rng(seed).normal(scale=2.0, size=(2, 10))
    vertices, directions = canonical_body(embedded_body())
    np.testing.assert_allclose(vertices, direct(np.zeros(10)), atol=1e-9)
    zero = add_shape(direct(first), directions, -first)
    np.testing.assert_allclose(zero, vertices, atol=1e-6)
    np.testing.assert_allclose(add_shape(zero, directions, second), direct(second), atol=1e-6)


def test_the_paper_s_removal_misses_the_motion_of_the_joints() -> None:
    body = embedded_body()
    betas = np.random.default_rng(4).normal(scale=2.0, size=10)
    weights = body.skin_weights.astype(np.float64)
    paper = template_shape_directions(body, weights, body.shape_directions, "paper")
    error = np.linalg.norm(add_shape(direct(np.zeros(10)), paper, betas) - direct(betas), axis=1)
    head = body.skin_weights[:, 15] > 0.99
    assert error[head].max() < 1e-6, "above the pelvis nothing is turned, so nothing is missed"
    feet = body.skin_weights[:, [7, 8, 10, 11]].sum(axis=1) > 0.99
    assert error[feet].mean() > 1e-3


def test_tears_are_found_counted_and_cut() -> None:
    before = np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    after = before.copy()
    after[3] += [0.2, 0, 0]
    tears = cut_tears(faces, before, after, growth=5.0, shortest=0.01)
    np.testing.assert_array_equal(tears.faces, faces[:1])
    assert (tears.torn_edges, tears.cut_faces) == (2, 1)
    assert tears.largest_growth == pytest.approx(np.hypot(0.2, 0.01) / 0.01, rel=0.06)
    whole = cut_tears(faces, before, before, growth=5.0, shortest=0.01)
    assert (whole.torn_edges, whole.cut_faces, len(whole.faces)) == (0, 0, 2)
    short = cut_tears(faces, before * 1e-3, after * 1e-3, growth=5.0, shortest=0.01)
    assert short.cut_faces == 0, "what is shorter than the limit is noise"
