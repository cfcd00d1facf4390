"""Garments: a `Pattern` is cut for the mean body in its rest pose, and `fit` grades it to a person.

Grading moves a pattern by the smoothed shape offsets of a body, so a garment of one person also fits another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.shared.cloth.material import Material
from stages.shared.layers import LAYER_OF_LABEL, label_of
from stages.shared.meshes import RayScene, face_normals
from stages.synth.bodies import ShapedBody
from stages.synth.cuts import Cut, flared_skirt, open_vest, t_shirt, trousers
from stages.synth.textures import ARGYLE, CHECKS, DOTS, STRIPES, TARTAN, Fabric

Doubles = NDArray[np.float64]

# Other materials than those that `gw fit-cloth` tries, so that a driver never has the truth's own settings.
JERSEY = Material(density=0.15, edge_stiffness=800.0, bending=4e-6, bending_damping=0.03, drag=1.6)
TWILL = Material(density=0.24, edge_stiffness=2500.0, bending=2e-5, bending_damping=0.04, drag=1.6)
WOOL = Material(density=0.3, edge_stiffness=2500.0, bending=1e-5, bending_damping=0.03, drag=1.6)

UPPER, LOWER, OUTER = label_of("upper"), label_of("lower"), label_of("outer")


@dataclass(frozen=True, eq=False)
class Garment:
    """One garment, fitted to a person.

    Attributes:
        name: what it is.
        label: id in label images.
        vertices: (V, 3) f64 metres, rest frame of the wearer: also its unstretched shape.
        faces: (F, 3) i64, normals away from the body.
        corner_uv: (F, 3, 2) f64 metres, texture coordinates per triangle corner.
        skin_weights: (V, 55) f64 of the nearest body surface.
        pinned: (V,) vertices that move with the bones.
        fabric: the pattern.
        material: mechanical properties.
        distance: metres kept from the body; outer layers keep more.
    """

    name: str
    label: int
    vertices: Doubles
    faces: NDArray[np.int64]
    corner_uv: Doubles
    skin_weights: Doubles
    pinned: NDArray[np.bool_]
    fabric: Fabric
    material: Material
    distance: float

    @property
    def layer(self) -> str:
        """The layer that the garment belongs to."""
        return LAYER_OF_LABEL[self.label]


@dataclass(frozen=True, eq=False)
class Pattern:
    """A garment before grading: its cut around the mean body, and its fabric."""

    name: str
    label: int
    cut: Cut
    fabric: Fabric
    material: Material
    distance: float


def wardrobe(mean: ShapedBody, spacing: float, seed: int) -> tuple[list[Pattern], list[Pattern]]:
    """What each of the two people wears, inner layer first."""
    ripple = float(np.random.default_rng(seed).uniform(0, 2 * np.pi))
    striped = Fabric(
        STRIPES, 0.052, ((0.93, 0.93, 0.90), (0.10, 0.16, 0.42), (0.96, 0.66, 0.10), (0.62, 0.10, 0.08))
    )
    tartan = Fabric(
        TARTAN, 0.118, ((0.66, 0.10, 0.10), (0.09, 0.22, 0.15), (0.95, 0.82, 0.25), (0.93, 0.93, 0.93))
    )
    dotted = Fabric(DOTS, 0.056, ((0.10, 0.44, 0.48), (0.96, 0.95, 0.88)))
    checked = Fabric(CHECKS, 0.046, ((0.80, 0.72, 0.58), (0.28, 0.22, 0.20)))
    argyle = Fabric(ARGYLE, 0.096, ((0.46, 0.09, 0.22), (0.90, 0.62, 0.20), (0.95, 0.93, 0.90)))
    shirt = t_shirt(mean, spacing)
    badge = Fabric(STRIPES, striped.period, striped.colors, (0.055, float(mean.joints[9, 1]) + 0.10, 0.042))
    first = [
        Pattern(
            "flared skirt", LOWER, flared_skirt(mean, spacing, tartan.period, ripple), tartan, TWILL, 0.005
        ),
        Pattern("striped T-shirt", UPPER, shirt, badge, JERSEY, 0.006),
    ]
    second = [
        Pattern("trousers", LOWER, trousers(mean, spacing), checked, TWILL, 0.005),
        Pattern("dotted T-shirt", UPPER, shirt, dotted, JERSEY, 0.006),
        Pattern("open vest", OUTER, open_vest(mean, spacing), argyle, WOOL, 0.012),
    ]
    return first, second


def fit(pattern: Pattern, mean: ShapedBody, wearer: ShapedBody) -> Garment:
    """Grade a pattern to the wearer: add the body's shape offsets, carried over and smoothed.

    Pinned vertices that come too near to the body are moved out: nothing else keeps them off it later.
    """
    cut = pattern.cut
    offsets = wearer.rest_vertices - mean.rest_vertices
    moved = cut.vertices + mean.transfer(cut.vertices, cut.faces, offsets)
    closest, face, _ = RayScene(wearer.rest_vertices, wearer.faces).closest(moved[cut.pinned])
    normals = face_normals(wearer.rest_vertices, wearer.faces)[0][face]
    height = ((moved[cut.pinned] - closest) * normals).sum(axis=1, keepdims=True)
    moved[cut.pinned] += np.maximum(pattern.distance - height, 0.0) * normals
    weights = mean.transfer(cut.vertices, cut.faces, mean.weights)
    weights = np.maximum(weights, 0.0)
    return Garment(
        pattern.name,
        pattern.label,
        moved,
        cut.faces,
        cut.corner_uv,
        weights / weights.sum(axis=1, keepdims=True),
        cut.pinned,
        pattern.fabric,
        pattern.material,
        pattern.distance,
    )
