"""Gaussians as glTF: points with the extension `KHR_gaussian_splatting` (Khronos, release candidate).

Scales are metres and opacities shares (not logarithms and logits as in `.ply`), rotations x y z w, colours
the constant spherical harmonic. `COLOR_0` shows a viewer without the extension coloured points; it is linear,
as glTF wants vertex colours.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData
from stages.shared.export.glb import GlbReader, GlbWriter
from stages.shared.pictures.srgb import linear_from_srgb
from stages.shared.splat.ply import HARMONIC, SplatCloud

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0
_CONSTANT = "SH_DEGREE_0_COEF_0"
# What every Gaussian has, and the shape of one.
_ATTRIBUTES: dict[str, tuple[int, ...]] = {
    "POSITION": (3,),
    f"{EXTENSION}:ROTATION": (4,),
    f"{EXTENSION}:SCALE": (3,),
    f"{EXTENSION}:OPACITY": (),
    f"{EXTENSION}:{_CONSTANT}": (3,),
}


def write_splat_glb(path: Path, cloud: SplatCloud, layers: tuple[str, ...] = ()) -> None:
    """Write the file whole or not at all: one node and mesh per layer, named by it.

    Arguments:
        layers: names that `cloud.layers` counts; () for one node of all Gaussians.

    Raises BadData for numbers that are not finite.
    """
    for name in ("means", "quats", "scales", "opacities", "colors"):
        if not np.isfinite(getattr(cloud, name)).all():
            raise BadData(f"{name} has a value that is not finite.", str(path), "Look for the step before.")
    glb = GlbWriter()
    nodes: list[dict[str, object]] = []
    meshes: list[dict[str, object]] = []
    owners = np.zeros(len(cloud), np.uint8) if not layers or cloud.layers is None else cloud.layers
    for index, name in enumerate(layers or ("gaussians",)):
        chosen = np.asarray(owners == index)
        if not chosen.any():
            continue
        nodes.append({"name": name, "mesh": len(meshes)})
        meshes.append({"name": name, "primitives": [_primitive(glb, cloud, chosen)]})
    glb.content |= {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
    }
    glb.write(path)


def read_splat_glb(path: Path) -> tuple[SplatCloud, tuple[str, ...]]:
    """Gaussians of all primitives with the extension, and the names of their meshes as layers.

    Raises MissingInput, BadData.
    """
    glb = GlbReader(path)
    parts, names = [], []
    for name, fields in _splat_primitives(glb, path):
        missing = [attribute for attribute in _ATTRIBUTES if attribute not in fields]
        if missing:
            raise BadData(f"A primitive has no attribute {missing[0]}.", str(path), "Export the file again.")
        part = [glb.array(fields[attribute]).astype(np.float32) for attribute in _ATTRIBUTES]
        if [values.shape for values in part] != [(len(part[0]), *shape) for shape in _ATTRIBUTES.values()]:
            raise BadData("A primitive's attributes do not fit together.", str(path), "Export it again.")
        parts.append(part)
        names.append(name)
    if not parts:
        raise BadData("The file holds no Gaussians.", str(path), "Give a file with KHR_gaussian_splatting.")
    means, turned, scales, opacities, constant = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    layers = np.repeat(np.arange(len(parts), dtype=np.uint8), [len(part[0]) for part in parts])
    colors = np.clip(0.5 + HARMONIC * constant, 0, 1).astype(np.float32)
    cloud = SplatCloud(means, np.roll(turned, 1, axis=1), scales, opacities, colors, None, layers)
    return cloud, tuple(names)


def _splat_primitives(glb: GlbReader, path: Path) -> Iterator[tuple[str, dict[str, int]]]:
    """Name of the mesh and attributes of every primitive with the extension."""
    try:
        for mesh in glb.content.get("meshes", []):
            for primitive in mesh.get("primitives", []):
                if EXTENSION in primitive.get("extensions", {}):
                    yield str(mesh.get("name", "")), dict(primitive["attributes"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BadData(
            f"The file does not list its meshes as glTF does ({error}).", str(path), "Export it again."
        ) from error


def _primitive(glb: GlbWriter, cloud: SplatCloud, chosen: NDArray[np.bool_]) -> dict[str, object]:
    colors = np.clip(cloud.colors[chosen], 0, 1).astype(np.float64)
    opacities = np.clip(cloud.opacities[chosen], 0, 1).astype(np.float32)
    shown = np.column_stack([linear_from_srgb(colors), opacities])
    attributes = {
        "POSITION": glb.array(cloud.means[chosen].astype(np.float32), bounds=True),
        "COLOR_0": glb.array(np.rint(255 * shown).astype(np.uint8), normalized=True),
        f"{EXTENSION}:ROTATION": glb.array(np.roll(cloud.quats[chosen], -1, axis=1).astype(np.float32)),
        f"{EXTENSION}:SCALE": glb.array(cloud.scales[chosen].astype(np.float32)),
        f"{EXTENSION}:OPACITY": glb.array(opacities),
        f"{EXTENSION}:{_CONSTANT}": glb.array(((colors - 0.5) / HARMONIC).astype(np.float32)),
    }
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    return {"mode": _POINTS, "attributes": attributes, "extensions": {EXTENSION: extension}}
