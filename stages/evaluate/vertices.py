"""Posed garments compared with their true meshes: `gw evaluate SUBJECT --true-meshes …`.

Points are the centres of the Gaussians of a garment. Each point belongs to a point of the cloth: the
nearest point of the true mesh to the template, in the frame of the template. The template defines this
binding, not the training. Errors of the training in that frame therefore count, and all methods are scored
on the same points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stages.evaluate.views import FrameViews
from stages.shared.avatar.deform import PosedGaussians, blended, moved, shaped_positions
from stages.shared.avatar.pose import pose_at
from stages.shared.body import Poses
from stages.shared.capture import Take
from stages.shared.capture.true_meshes import TrueMesh, TrueMeshes
from stages.shared.errors import MissingInput
from stages.shared.layers import LAYERS, SLOTS
from stages.shared.metrics.vertex_error import (
    STATISTICS,
    Binding,
    Faces,
    Points,
    bind,
    material_distances,
    spanned_triangles,
    statistics,
    surface_distances,
)
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.outfit import Outfit
from stages.shared.report import Report

REACH = 0.02  # metres; a texel farther from the true template is no point of the cloth (a filled hole)
Centres = Callable[[Poses, int], dict[str, Points]]
PosedLayers = Callable[[Poses, int], dict[str, PosedGaussians]]


@dataclass(frozen=True, eq=False)
class Posing:
    """A way of posing garments.

    Attributes:
        centres: poses and row -> garment to (N, 3) f32 m, world.
        bones: the same points moved by the bones alone, without anything learned.
        triangles: garment to (M, 3), between neighbours among its points.
    """

    centres: Centres
    bones: Centres
    triangles: Mapping[str, Faces]


@dataclass(frozen=True, eq=False)
class _Garment:
    """Where a garment's texels are: in which worn layer, and their (n,) indices there."""

    worn: str
    texels: NDArray[np.int64]


@dataclass
class _Distances:
    """Distances of one way of posing and one garment, by frame; without `material` where that is unknown."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    arrays: list[dict[str, NDArray[np.float64]]] = field(default_factory=list)


def posing_of(outfit: Outfit, posed: PosedLayers | None = None) -> Posing:
    """How an outfit's garments are posed; `posed` in place of `outfit.posed`, with the same texels."""
    garments = _garments(outfit)
    layers = {layer.name: layer for layer in outfit.layers}

    def centres(poses: Poses, frame: int) -> dict[str, Points]:
        gaussians = (posed or outfit.posed)(poses, frame)
        return {name: gaussians[g.worn].means.numpy()[g.texels] for name, g in garments.items()}

    def bones(poses: Poses, frame: int) -> dict[str, Points]:
        by_layer = _bones_alone(outfit, poses, frame)
        return {name: by_layer[g.worn][g.texels] for name, g in garments.items()}

    triangles = {name: _triangles(layers[g.worn], g.texels) for name, g in garments.items()}
    return Posing(centres, bones, triangles)


def posings_of(
    outfits: Mapping[str, Outfit], posed: Mapping[str, PosedLayers] | None = None
) -> dict[str, Posing]:
    """Name to way of posing, and "bones": the points of the first outfit moved by the bones alone.

    `posed`, by name, takes the place of `Outfit.posed`.
    """
    found = {name: posing_of(outfit, (posed or {}).get(name)) for name, outfit in outfits.items()}
    first = next(iter(found.values()))
    return {**found, "bones": Posing(first.bones, first.bones, first.triangles)}


def vertex_errors(
    splits: Mapping[str, Sequence[FrameViews]],
    meshes: Mapping[str, TrueMeshes],
    posings: Mapping[str, Posing],
    template: tuple[Take, int],
    report: Report,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Distances of every way of posing in every frame that has true meshes.

    Arguments:
        splits: name to frames. meshes: take to its true meshes. posings: name to way of posing.
        template: the take and frame that the garments' template shows.

    Returns:
        split -> way of posing (and the same `_without_first`) -> garment -> statistics; rows by frame.

    Raises:
        MissingInput: no frame has true meshes, or no garment is among them.
    """
    known = {split: [views for views in frames if _has(meshes, views)] for split, frames in splits.items()}
    bindings = {name: _bindings(posing, meshes, template) for name, posing in posings.items()}
    summary: dict[str, Any] = {}
    rows: list[dict[str, Any]] = []
    for split, frames in known.items():
        report.step(f"true meshes: {split.replace('_', ' ')}")
        by_garment: dict[tuple[str, str], _Distances] = {}
        for done, views in enumerate(frames):
            for name, posing in posings.items():
                _add_frame(by_garment, name, posing, meshes[views.take.name], views, bindings[name])
            report.progress(done + 1, len(frames))
        for (name, garment), found in by_garment.items():
            _summarise(summary.setdefault(split, {}), name, garment, found)
            rows += [{"split": split, "method": name, "layer": garment, **row} for row in found.rows]
    if not rows:
        raise MissingInput(
            "The scored frames and the true meshes have no garment in common.",
            ", ".join(meshes),
            "Give the true meshes of the takes that are scored: --true-meshes TAKE=FILE.",
        )
    return summary, rows


def _garments(outfit: Outfit) -> dict[str, _Garment]:
    """Garments of an outfit; those of a baseline are parts of a layer."""
    found = {}
    for layer in outfit.layers:
        if layer.layer_ids is None:
            if layer.name in SLOTS:
                found[layer.name] = _Garment(layer.name, np.arange(len(layer.maps)))
            continue
        for slot in SLOTS:
            texels = np.flatnonzero(layer.layer_ids.numpy() == LAYERS.index(slot))
            if len(texels):
                found[slot] = _Garment(layer.name, texels)
    return found


def _triangles(layer: WornLayer, texels: NDArray[np.int64]) -> Faces:
    """Triangles among some texels of a layer, in their own numbers."""
    number = np.full(len(layer.maps), -1)
    number[texels] = np.arange(len(texels))
    triangles = number[spanned_triangles(layer.maps.neighbours.numpy())]
    return triangles[(triangles >= 0).all(axis=1)].astype(np.int32)


@torch.no_grad()
def _bones_alone(outfit: Outfit, poses: Poses, frame: int) -> dict[str, Points]:
    """Worn layer to its texels (N, 3) m, world, without offsets."""
    pose = pose_at(outfit.body_model, poses, frame, outfit.betas)
    return {
        layer.name: moved(
            shaped_positions(layer.maps, pose.betas), blended(layer.maps.skin_weights, pose.transforms)
        ).numpy()
        for layer in outfit.layers
    }


def _has(meshes: Mapping[str, TrueMeshes], views: FrameViews) -> bool:
    return views.take.name in meshes and views.frame in meshes[views.take.name].rows


def _bindings(
    posing: Posing, meshes: Mapping[str, TrueMeshes], template: tuple[Take, int]
) -> dict[str, tuple[Binding, TrueMesh]]:
    """Garment to what its points are on the true mesh of the template's frame, where that is known."""
    take, frame = template
    known = meshes.get(take.name)
    if known is None or frame not in known.rows:
        return {}
    points = posing.bones(take.poses, frame)
    return {
        name: (bind(points[name], known.at(name, frame), mesh.faces, REACH), mesh)
        for name, mesh in known.layers.items()
        if name in points
    }


def _add_frame(
    by_garment: dict[tuple[str, str], _Distances],
    name: str,
    posing: Posing,
    truth: TrueMeshes,
    views: FrameViews,
    bindings: Mapping[str, tuple[Binding, TrueMesh]],
) -> None:
    """Measure one frame."""
    for garment, points in posing.centres(views.take.poses, views.frame).items():
        if garment not in truth.layers:
            continue
        mesh, vertices = truth.layers[garment], truth.at(garment, views.frame)
        there, back = surface_distances(points, posing.triangles[garment], vertices, mesh.faces)
        distances = {"to_truth": there, "from_truth": back}
        if garment in bindings and bindings[garment][1].same_cloth(mesh):
            binding = bindings[garment][0]
            distances["material"] = material_distances(binding, points, vertices)
        found = by_garment.setdefault((name, garment), _Distances())
        found.arrays.append(distances)
        figures = {kind: statistics(values) for kind, values in distances.items()}
        found.rows.append(
            {"take": views.take.name, "frame": views.frame, "first": views.first, **_all_kinds(figures)}
        )


def _summarise(summary: dict[str, Any], name: str, garment: str, found: _Distances) -> None:
    """Statistics over all points of all frames, and again without the first frame of each take."""
    later = [arrays for arrays, row in zip(found.arrays, found.rows, strict=True) if not row["first"]]
    for label, chosen in ((name, found.arrays), (f"{name}_without_first", later)):
        if not chosen or (label != name and len(later) == len(found.arrays)):
            continue
        kinds = set.intersection(*(set(arrays) for arrays in chosen))
        figures = {
            kind: statistics(np.concatenate([arrays[kind] for arrays in chosen])) for kind in sorted(kinds)
        }
        entry = {"frames": len(chosen), **_all_kinds(figures)}
        entry["points"] = len(chosen[0]["to_truth"])
        entry["points_of_the_cloth"] = len(chosen[0]["material"]) if "material" in kinds else None
        summary.setdefault(label, {})[garment] = entry


def _all_kinds(figures: Mapping[str, dict[str, float | None]]) -> dict[str, Any]:
    """Each kind of distance, null where it is unknown, and the mean of both ways between the surfaces."""
    there, back = figures["to_truth"], figures["from_truth"]
    both = {kind: _middle(there[kind], back[kind]) for kind in STATISTICS}
    material = figures.get("material", dict.fromkeys(STATISTICS))
    return {"material": material, "surface": both, "to_truth": there, "from_truth": back}


def _middle(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else round((one + other) / 2, 6)
