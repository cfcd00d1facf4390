"""Exact removal of the subject's shape from the canonical template, and the inverse with any shape."""

from __future__ import annotations

import numpy as np
import torch

from stages.shared.body.canonical import canonical_from_rest, canonical_shape_directions
from stages.shared.body.kinematics import skin
from stages.shared.body.model import BodyModel


def template_shape_directions(
    body: BodyModel, weights: np.ndarray, rest_directions: np.ndarray, removal: str = "exact"
) -> np.ndarray:
    """How canonical points move per unit of shape, (V, 10, 3) metres, canonical frame.

    Arguments:
        weights: (V, 55). rest_directions: (V, 3, 10) metres, rest frame.
        removal: "exact" includes the motion of the joints, so x(β) = x(0) + Σ_b β_b d_b without remainder;
            "paper" only turns the rest-frame offsets by the blended bone rotations.
    """
    if removal == "paper":
        turn = canonical_from_rest(body, torch.zeros(10, dtype=torch.float64))[:, :3, :3].numpy()
        return np.einsum("vj,jab,vbk->vka", weights, turn, rest_directions, optimize=True)
    directions = canonical_shape_directions(
        body,
        torch.as_tensor(weights, dtype=torch.float64),
        torch.as_tensor(rest_directions, dtype=torch.float64),
    )
    return directions.numpy()


def add_shape(points: np.ndarray, directions: np.ndarray, betas: np.ndarray) -> np.ndarray:
    """x + Σ_b β_b d_b for points (V, 3), directions (V, 10, 3), betas (10,); negative betas remove."""
    return points + np.einsum("vbk,b->vk", directions, np.asarray(betas, dtype=np.float64))


def canonical_body(body: BodyModel) -> tuple[np.ndarray, np.ndarray]:
    """The zero-shape body in the canonical pose: vertices (V, 3) metres, shape directions (V, 10, 3)."""
    weights = body.skin_weights.astype(np.float64)
    zero = torch.zeros(10, dtype=torch.float64)
    vertices = skin(
        torch.as_tensor(body.template_vertices, dtype=torch.float64),
        torch.from_numpy(weights),
        canonical_from_rest(body, zero),
    )
    return vertices.numpy(), template_shape_directions(body, weights, body.shape_directions)
