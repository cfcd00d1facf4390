"""Gaussians as glTF: points with the extension `KHR_gaussian_splatting` (Khronos, release candidate).

Scales are metres and opacities shares (not logarithms and logits as in `.ply`), rotations x y z w, colours
the constant spherical harmonic. `COLOR_0` shows a viewer without the extension coloured points; it is linear,
as glTF wants vertex colours.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData
from stages.shared.export.glb import GlbReader, GlbWriter
from stages.shared.splat.ply import HARMONIC, SplatCloud

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0


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
    for mesh in glb.content.get("meshes", []):
        for primitive in mesh.get("primitives", []):
            if EXTENSION not in primitive.get("extensions", {}):
                continue
            fields = primitive["attributes"]
            wanted = ["POSITION"]
            wanted += [f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", _CONSTANT)]
            missing = [name for name in wanted if name not in fields]
            if missing:
                raise BadData(
                    f"A primitive has no attribute {missing[0]}.", str(path), "Export the file again."
                )
            parts.append([glb.array(fields[name]).astype(np.float32) for name in wanted])
            names.append(str(mesh.get("name", "")))
    if not parts:
        raise BadData("The file holds no Gaussians.", str(path), "Give a file with KHR_gaussian_splatting.")
    means, turned, scales, opacities, constant = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    layers = np.repeat(np.arange(len(parts), dtype=np.uint8), [len(part[0]) for part in parts])
    colors = np.clip(0.5 + HARMONIC * constant, 0, 1).astype(np.float32)
    cloud = SplatCloud(means, np.roll(turned, 1, axis=1), scales, opacities, colors, None, layers)
    return cloud, tuple(names)


_CONSTANT = "SH_DEGREE_0_COEF_0"


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


def linear_from_srgb(colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear light of sRGB values 0..1 (IEC 61966-2-1)."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
