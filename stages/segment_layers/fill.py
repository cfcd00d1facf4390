"""Colours for what no image has seen: a smooth continuation of what was."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from stages.shared.fields.diffusion import conjugate_gradient, graph_laplacian
from stages.shared.meshes.regions import mesh_edges

_HOLD = 30.0  # how firmly a fully trusted colour holds against its neighbours
_SCREEN = 1e-4  # pull of the middle colour far away from everything seen


def fill_colors(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, confidence: np.ndarray
) -> np.ndarray:
    """Colours (V, 3): trusted ones stay, the rest is the harmonic continuation over the surface.

    Minimises Σ_edges |c_u − c_v|² + Σ_v hold·trust_v |c_v − colour_v|², with a faint pull to the median
    trusted colour, which decides for pieces of the mesh that no image sees.

    Arguments:
        vertices: (V, 3) metres. faces: (F, 3). colors: (V, 3). confidence: (V,) ≥ 0; 0 is unseen.
    """
    trust = _trust(confidence)
    middle = np.median(colors[trust > 0.5], axis=0) if (trust > 0.5).any() else np.full(3, 0.5)
    laplacian = graph_laplacian(mesh_edges(vertices, faces), len(vertices))
    hold = _HOLD * trust
    right = hold[:, None] * colors + _SCREEN * middle
    start = np.where(trust[:, None] > 0, colors, middle)
    matrix = (laplacian + sparse.diags(hold) + _SCREEN * sparse.identity(len(vertices))).tocsr()
    return np.clip(conjugate_gradient(matrix, right, start, 1e-6, 600), 0.0, 1.0)


def _trust(confidence: np.ndarray) -> np.ndarray:
    """(V,) 0 to 1: confidence against the median of what was seen at all."""
    seen = confidence > 0
    if not seen.any():
        return np.zeros(len(confidence))
    return np.clip(confidence / np.median(confidence[seen]), 0.0, 1.0)
