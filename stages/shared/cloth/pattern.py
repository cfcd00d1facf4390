"""What a garment needs to be simulated on any body: its mesh, pins and material, and its riding texels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.artifacts.bundle_cloth import CLOTH_ARRAYS, check_cloth_layout, check_cloth_values
from stages.shared.body import BodyModel, posed_from_canonical
from stages.shared.cloth.material import Material
from stages.shared.cloth.riding import Riding
from stages.shared.cloth.simulator import Garment, garment
from stages.shared.meshes import edges

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

_SHORTEST_GRADED = 1e-3  # metres; how a shorter edge grows is noise
_MOST_GROWTH = 3.0

_TYPES = {np.dtype(np.float32): "F32", np.dtype(np.int32): "I32"}


@dataclass(frozen=True, eq=False)
class ClothPattern:
    """A garment's simulation mesh and what goes with it.

    Attributes:
        vertices: (V, 3) f32 m, canonical, zero shape.
        rest_vertices: (V, 3) f32 m, world, in the template's pose on the person it was learned from.
        rest_lengths: (E,) f32 m of `meshes.edges(faces)`.
        faces: (F, 3) i32.
        pinned: (V,) i32, 1 where a vertex follows the body.
        skin_margin: (V,) f32 m to keep from the body; negative where the template lies inside it.
        skin_weights: (V, 55) f32, rows sum to 1. shape_directions: (V, 10, 3) f32 m per unit of shape.
        pose: (55, 3) f32 axis-angle of the template's pose.
        texel_faces: (N,) i32, texel_weights, texel_offsets: (N, 3) f32, see `Riding`.
        material: see Material.
        betas: (10,) f32 shape of the person it was learned from.
    """

    vertices: Floats
    rest_vertices: Floats
    rest_lengths: Floats
    faces: NDArray[np.int32]
    pinned: NDArray[np.int32]
    skin_margin: Floats
    skin_weights: Floats
    shape_directions: Floats
    pose: Floats
    texel_faces: NDArray[np.int32]
    texel_weights: Floats
    texel_offsets: Floats
    material: Material
    betas: Floats

    @property
    def riding(self) -> Riding:
        """How the texels sit on the mesh."""
        return Riding(self.texel_faces, self.texel_weights, self.texel_offsets)

    def graded(self, body: BodyModel, betas: NDArray) -> ClothPattern:
        """The pattern cut for a wearer: every edge grows as the body's shape makes the skinned garment grow.

        Arguments:
            betas: (10,) shape of the wearer. On the person it was learned from, the pattern stays as it is.
        """
        ends = edges(self.faces)
        lengths = []
        for shape in (self.betas, betas):
            skin = PatternSkin(self, body, shape)
            vertices = skin.positions(skin.transforms(self.pose, np.zeros(3)))
            lengths.append(np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1))
        own, worn = np.maximum(lengths, _SHORTEST_GRADED)
        growth = np.clip(worn / own, 1 / _MOST_GROWTH, _MOST_GROWTH)
        return replace(self, rest_lengths=(self.rest_lengths * growth).astype(np.float32))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays by name; inverse of `from_arrays`."""
        return {name: getattr(self, name) for name in CLOTH_ARRAYS}

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, NDArray[Any]], material: Material, betas: NDArray, texels: int, where: str
    ) -> ClothPattern:
        """The pattern in the arrays of a file, checked.

        Arguments:
            betas: (10,) shape of the person it was learned from. texels: of the garment's maps.

        Raises:
            BadData: an array is missing or of another shape or type, an index names nothing, a value is not
                finite or lies outside what a garment can have.
        """
        layout = {name: (_TYPES.get(array.dtype, "?"), array.shape) for name, array in arrays.items()}
        check_cloth_layout(layout, texels, where)
        check_cloth_values(arrays, where)
        checked = {name: np.ascontiguousarray(arrays[name]) for name in CLOTH_ARRAYS}
        return cls(material=material, betas=np.asarray(betas, dtype=np.float32), **checked)

    def garment(self, name: str) -> Garment:
        """The garment for a Simulator."""
        one = garment(name, self.rest_vertices, self.faces, self.pinned > 0, self.material, self.skin_margin)
        numbers = {tuple(pair): index for index, pair in enumerate(edges(self.faces).tolist())}
        order = [numbers[tuple(pair)] for pair in np.sort(one.constraints.edges, axis=1).tolist()]
        rest = self.rest_lengths.astype(np.float64)[order]
        return replace(one, constraints=one.constraints._replace(edge_rest=rest))


class PatternSkin:
    """The vertices of a pattern on a body of one shape, moved by bones alone: its start and its pins."""

    def __init__(self, pattern: ClothPattern, body: BodyModel, betas: NDArray) -> None:
        self._body = body
        self._betas = torch.as_tensor(np.asarray(betas), dtype=torch.float64)
        shaped = pattern.vertices + np.einsum("b,vbc->vc", betas, pattern.shape_directions)
        self._shaped, self._weights = shaped.astype(np.float64), pattern.skin_weights.astype(np.float64)

    def transforms(self, rotations: NDArray, translation: NDArray) -> Doubles:
        """(55, 4, 4) posed_from_canonical of the body's bones."""
        turns = torch.as_tensor(np.asarray(rotations), dtype=torch.float64)
        move = torch.as_tensor(np.asarray(translation), dtype=torch.float64)
        return np.asarray(posed_from_canonical(self._body, turns, move, self._betas).numpy())

    def positions(self, transforms: Doubles, chosen: NDArray | None = None) -> Doubles:
        """(V, 3) metres, world; with `chosen` (V,) only those vertices."""
        shaped, weights = self._shaped, self._weights
        if chosen is not None:
            shaped, weights = shaped[chosen], weights[chosen]
        blended = (weights @ transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        return np.asarray((blended[:, :, :3] @ shaped[:, :, None])[:, :, 0] + blended[:, :, 3])
