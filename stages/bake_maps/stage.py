"""Turn every layer mesh into front and back maps of texels on one grid; each texel will carry a Gaussian.

Reads:
    register-template   the template's frame and take
    canonicalize        body.safetensors (the grid's centre)
    segment-layers      <layer>.safetensors
    capture             images, masks and label images of the template's frame, training cameras
Writes:
    <layer>.safetensors texels (N,3) i32 view, row, column on the grid, in that order: view 0 is met first
                        from the front, 1 from the back; 2, 4, … are peeled off below and face the front,
                        3, 5, … the back;
                        window (4,) i32 row0, column0, height, width;
                        positions (N,3) f32 m canonical zero-shape; normals (N,3) f32 unit, canonical;
                        skin_weights (N,55) f32; shape_directions (N,10,3) f32 m per unit of shape, canonical;
                        neighbours (N,4) i32 up right down left facing the same side, −1 none or a depth
                        jump; seams (S,2) i32 texels facing front and back that meet where the surface turns;
                        spacing (N,) f32 m initial standard deviation of a Gaussian;
                        colors (N,3) f32 sRGB 0..1; color_confidence (N,) f32, 0 where filled;
                        labels (N,) u8
    preview.png         colours and normals of all maps
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stages.bake_maps.config import BakeMapsConfig
from stages.bake_maps.grid import Grid
from stages.bake_maps.peel import unseen_shares
from stages.bake_maps.picture import maps_picture
from stages.bake_maps.texels import Texels, cast_texels
from stages.pipeline import BAKE_MAPS, CANONICALIZE, REGISTER_TEMPLATE, SEGMENT_LAYERS
from stages.shared.artifacts import Inputs, StageResult, Workspace
from stages.shared.capture import Take
from stages.shared.capture.layer_colors import layer_colors
from stages.shared.capture.scaled_take import picture_scales, scaled_for_texels
from stages.shared.capture.template_views import frame_files, template_take
from stages.shared.meshes.raycast import RayScene
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.shared.texel_maps import (
    ARRAYS,
    OTHER_ARRAYS,
    initial_sigma,
    neighbour_texels,
    seam_pairs,
    texel_numbers,
)

_ABOUT = {
    **{name: array.about for name, array in ARRAYS.items()},
    **OTHER_ARRAYS,
    "labels": "layer label ids (N,)",
}
Mesh = dict[str, np.ndarray]


def run(
    subject: Path, config: BakeMapsConfig = BakeMapsConfig(), report: Report = SILENT, force: bool = False
) -> StageResult:
    """Bake the maps of every layer of a subject.

    Raises:
        MissingInput: an earlier stage has not run.
        BadData: a layer reaches beyond the grid, or has no surface.
    """
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    canonical, segmented = workspace.require(CANONICALIZE), workspace.require(SEGMENT_LAYERS)
    capture, take = template_take(workspace, registered) if config.project_colors else (None, None)
    frame = int(segmented.summary["frame"])
    inputs: Inputs = {
        "canonicalize": canonical,
        "segment-layers": segmented,
        **frame_files(capture, take, frame),
    }
    if done := workspace.reuse(BAKE_MAPS, config, inputs, report, force):
        return done
    with workspace.build(BAKE_MAPS, config, inputs, force) as build:
        meshes = {name: segmented.arrays(name) for name in segmented.summary["layers"]}
        grid = Grid.around(canonical.arrays("body")["vertices"], config.pitch, config.extent_m)
        scene = RayScene.of_parts([(mesh["world_vertices"], mesh["faces"]) for mesh in meshes.values()])
        take = reduced_take(take, scene.vertices, config)
        baked, unseen = {}, {}
        for name, mesh in meshes.items():
            report.step(f"baking {name}")
            unseen[name] = unseen_shares(mesh["vertices"], mesh["faces"])
            sheets = sheets_needed(unseen[name], config)
            texels = cast_texels(mesh["vertices"], mesh["faces"], grid, name, sheets)
            maps = bake_layer(mesh, texels, grid, config)
            add_texel_colors(maps, mesh, texels, scene, take, frame)
            build.write_arrays(name, maps, _ABOUT)
            baked[name] = (texels, maps["colors"], maps["normals"])
        build.write_picture("preview.png", maps_picture(list(baked.values())))
        build.summary(**_summary(grid, {name: part[0] for name, part in baked.items()}, unseen))
    summary = build.artifact.summary
    for name, share in summary["unseen_area"].items():
        if share > config.unseen_limit:
            report.warn(f"{100 * share:.1f} % of the surface of {name} is on no map")
    return StageResult(build.artifact, summary)


def plan(subject: Path, config: BakeMapsConfig = BakeMapsConfig()) -> Plan:
    """What `run` would read, write and cost."""
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    canonical, segmented = workspace.require(CANONICALIZE), workspace.require(SEGMENT_LAYERS)
    _, take = template_take(workspace, registered) if config.project_colors else (None, None)
    small = reduced_take(take, registered.arrays("template")["vertices"], config)
    texels = int(2.0 / config.pitch**2)  # two views of about one square metre each
    return Plan(
        inputs=[str(canonical.path), str(segmented.path)],
        outputs=[str(workspace.root / BAKE_MAPS.name)],
        config=asdict(config) | {"picture_scale": picture_scales(small)},
        seconds=1.0 + texels * 2e-5,
        memory_bytes=370_000_000 + texels * 4000,
        disk_bytes=texels * 540,
    )


def reduced_take(take: Take | None, vertices: np.ndarray, config: BakeMapsConfig) -> Take | None:
    """The take with pictures of the detail that texels can show; vertices (V, 3), world, metres."""
    return take and scaled_for_texels(take, vertices.mean(axis=0), config.pitch, config.picture_scale)


def sheets_needed(unseen: np.ndarray, config: BakeMapsConfig) -> int:
    """Fewest peeled sheets a side that leave no more unseen than allowed, from shares (0, 1, … sheets)."""
    enough = np.flatnonzero(unseen <= config.unseen_limit)
    return min(int(enough[0]) if len(enough) else len(unseen) - 1, config.most_sheets)


def bake_layer(mesh: Mesh, texels: Texels, grid: Grid, config: BakeMapsConfig) -> Mesh:
    """Arrays of one layer's texels, colours interpolated from the mesh.

    Arguments:
        mesh: vertices, faces, skin_weights, shape_directions, colors, color_confidence, labels per vertex.
    """
    faces = mesh["faces"]
    positions = texels.interpolate(faces, mesh["vertices"])
    normals = texels.outward(mesh["vertices"], faces, mesh["vertices"])
    weights = np.maximum(texels.interpolate(faces, mesh["skin_weights"]), 0.0)
    numbers = texel_numbers(texels.texels, texels.window, texels.views)
    jump = max(config.depth_jump_m, 3.0 * grid.pitch)
    neighbours = neighbour_texels(numbers, texels.texels, texels.window, positions[:, 2], jump)
    corner = faces[texels.face, texels.barycentric.argmax(axis=1)]
    return {
        "texels": texels.texels,
        "window": np.array(texels.window, dtype=np.int32),
        "positions": positions.astype(np.float32),
        "normals": normals.astype(np.float32),
        "skin_weights": (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        "shape_directions": texels.interpolate(faces, mesh["shape_directions"]).astype(np.float32),
        "neighbours": neighbours,
        "seams": seam_pairs(numbers, neighbours, positions, normals, config.seam_reach_m, jump),
        "spacing": initial_sigma(
            normals, grid.pitch, config.sigma_per_spacing, config.largest_stretch
        ).astype(np.float32),
        "colors": (texels.interpolate(faces, mesh["colors"]) / 255).astype(np.float32),
        "color_confidence": texels.interpolate(faces, mesh["color_confidence"]).astype(np.float32),
        "labels": mesh["labels"][corner],
    }


def add_texel_colors(
    maps: Mesh, mesh: Mesh, texels: Texels, scene: RayScene, take: Take | None, frame: int
) -> None:
    """Replace interpolated colours by the images' own at every texel, as far as the images see it."""
    if take is None:
        return
    faces = mesh["faces"]
    world = texels.interpolate(faces, mesh["world_vertices"])
    normals = texels.outward(mesh["world_vertices"], faces, mesh["vertices"])
    tucked = texels.interpolate(faces, mesh["ring"]) > 0
    colors, confidence = layer_colors(world, normals, maps["labels"], scene, take, frame)
    confidence = np.where(tucked, 0, confidence).astype(np.float32)
    # Below this a texel is on a silhouette in every view: the smooth colour of the mesh is the better start.
    share = np.clip(confidence / 0.2, 0, 1)[:, None]
    maps["colors"] = (share * colors + (1 - share) * maps["colors"]).astype(np.float32)
    maps["color_confidence"] = confidence


def _summary(grid: Grid, texels: dict[str, Texels], unseen: dict[str, np.ndarray]) -> dict[str, Any]:
    windows = {name: part.window[2] * part.window[3] for name, part in texels.items()}
    count = sum(len(part.texels) for part in texels.values())
    sheets = {name: part.views // 2 - 1 for name, part in texels.items()}
    return {
        "layers": list(texels),
        "pitch": grid.pitch,
        "centre": [float(value) for value in grid.centre],
        "grid_size": grid.size,
        "texels": {name: len(part.texels) for name, part in texels.items()},
        "peeled_sheets": sheets,
        "unseen_area_two_views": {name: float(shares[0]) for name, shares in unseen.items()},
        "unseen_area": {name: float(unseen[name][number]) for name, number in sheets.items()},
        "window_share": {name: area / grid.size**2 for name, area in windows.items()},
        # Of front and back maps of the whole grid for every layer: what the networks compute, what is stored.
        "windows_of_full_maps": sum(windows.values()) / (len(texels) * grid.size**2),
        "texels_of_full_maps": count / (2 * len(texels) * grid.size**2),
    }
