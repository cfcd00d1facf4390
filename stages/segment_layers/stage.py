"""Split the template into layers: the body, and a mesh for every garment that is there.

Reads:
    register-template   template.safetensors (vertices (V,3) m world, faces; colors, labels if any),
                        body.safetensors, smpl_params.npz
    canonicalize        template.safetensors, body.safetensors (canonical zero-shape, weights, directions)
    capture             images, masks and label images of the template's frame, training cameras
Writes:
    <layer>.safetensors vertices (V,3) f32 m canonical zero-shape, faces (F,3) i32, skin_weights (V,55) f32,
                        shape_directions (V,10,3) f32 m per unit of shape, world_vertices (V,3) f32 m world,
                        colors (V,3) u8 sRGB (filled where unseen), color_confidence (V,) f32 (0 if filled),
                        labels (V,) u8, ring (V,) i32 (0 own surface, r tucked under a neighbour)
    labels.safetensors  labels (V,) u8 of the template's vertices
    preview.png         the template in label colours, front and back
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stages.pipeline import CANONICALIZE, REGISTER_TEMPLATE, SEGMENT_LAYERS
from stages.segment_layers.config import SegmentLayersConfig
from stages.segment_layers.fill import fill_colors
from stages.segment_layers.layers import Template, body_layer, body_surface, garment_layer, slots_of
from stages.shared.artifacts import Artifact, Inputs, StageResult, Workspace
from stages.shared.capture import Take, label_picture
from stages.shared.capture.layer_colors import has_label_images, layer_colors
from stages.shared.capture.projection import project_labels
from stages.shared.capture.scaled_take import picture_scales, scaled_for_texels
from stages.shared.capture.template_views import frame_files, template_take
from stages.shared.errors import MissingInput
from stages.shared.layers import BODY, GARMENT_LABELS, LABELS, LAYER_OF_LABEL, NO_LABEL, label_legend
from stages.shared.meshes.labelling import known_labels, label_vertices, tidy_labels
from stages.shared.meshes.picture import two_sided_picture
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.regions import vertex_areas
from stages.shared.meshes.topology import vertex_normals
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report

_ABOUT = {
    "faces": "vertex numbers (F,3)",
    "vertices": "m canonical zero-shape (V,3)",
    "world_vertices": "m world at the template frame (V,3)",
    "skin_weights": "rows sum to 1 (V,55)",
    "shape_directions": "m per unit of shape, canonical (V,10,3)",
    "colors": "sRGB (V,3)",
    "color_confidence": "cosine of the best view, 0 where filled (V,)",
    "labels": "layer label ids (V,)",
    "ring": "0 own surface, r-th ring tucked under a neighbour (V,)",
}


def run(
    subject: Path,
    config: SegmentLayersConfig = SegmentLayersConfig(),
    report: Report = SILENT,
    force: bool = False,
) -> StageResult:
    """Segment the canonical template of a subject.

    Raises:
        MissingInput: an earlier stage has not run, or there are no labels; says what to provide.
    """
    workspace = Workspace(subject)
    registered, canonical = workspace.require(REGISTER_TEMPLATE), workspace.require(CANONICALIZE)
    capture, take = template_take(workspace, registered)
    frame = int(registered.summary["frame"])
    inputs: Inputs = {
        "register-template": registered,
        "canonicalize": canonical,
        **frame_files(capture, take, frame),
    }
    if done := workspace.reuse(SEGMENT_LAYERS, config, inputs, report, force):
        return done
    with workspace.build(SEGMENT_LAYERS, config, inputs, force) as build:
        template = Template.load(registered.arrays("template"), canonical.arrays("template"))
        take = reduced_take(take, template.world, template.faces, config)

        report.step("labelling the template")
        labels, source = choose_labels(template, take, frame, config)

        report.step("cutting out the layers")
        body = body_surface(registered, canonical)
        layers = {BODY: body_layer(template, labels, body)}
        for label in GARMENT_LABELS:
            garment = garment_layer(template, labels, label, config, body)
            if len(garment["faces"]):
                layers[LAYER_OF_LABEL[label]] = garment

        report.step("projecting colours")
        scene = RayScene.of_parts([(mesh["world_vertices"], mesh["faces"]) for mesh in layers.values()])
        for name, mesh in layers.items():
            add_colors(mesh, scene, take, frame)
            build.write_arrays(name, mesh, _ABOUT)
        build.write_arrays(
            "labels", {"labels": labels}, {"labels": "layer label ids of template vertices (V,)"}
        )
        picture = two_sided_picture(template.canonical["vertices"], template.faces, label_picture(labels))
        build.write_picture("preview.png", picture)
        build.summary(**_summary(template, labels, source, layers, registered))
    _report_layers(build.artifact.summary, report)
    return StageResult(build.artifact, build.artifact.summary)


def plan(subject: Path, config: SegmentLayersConfig = SegmentLayersConfig()) -> Plan:
    """What `run` would read, write and cost."""
    workspace = Workspace(subject)
    registered, canonical = workspace.require(REGISTER_TEMPLATE), workspace.require(CANONICALIZE)
    capture, take = template_take(workspace, registered)
    mesh = registered.arrays("template")
    small = reduced_take(take, mesh["vertices"], mesh["faces"], config)
    vertices = len(mesh["vertices"])
    inputs = [str(registered.path), str(canonical.path)]
    return Plan(
        inputs=inputs + ([str(capture.root)] if capture else []),
        outputs=[str(workspace.root / SEGMENT_LAYERS.name)],
        config=asdict(config) | {"picture_scale": picture_scales(small)},
        seconds=1.0 + vertices * 7e-5,
        memory_bytes=600_000_000 + vertices * 4000,
        disk_bytes=3_000_000 + vertices * 370,
    )


def reduced_take(
    take: Take | None, vertices: np.ndarray, faces: np.ndarray, config: SegmentLayersConfig
) -> Take | None:
    """The take with pictures of the detail that a mesh of vertices (V, 3), world, metres, can show."""
    if take is None:
        return None
    spacing = float(np.sqrt(vertex_areas(vertices, faces).sum() / len(vertices)))
    return scaled_for_texels(take, vertices.mean(axis=0), spacing, config.picture_scale)


def choose_labels(
    template: Template, take: Take | None, frame: int, config: SegmentLayersConfig
) -> tuple[np.ndarray, str]:
    """Labels (V,) u8 of the template, and where they came from: "images" or "scan".

    Raises:
        MissingInput: the asked-for labels are not there; says what to provide.
    """
    from_images = take is not None and has_label_images(take, frame)
    source = config.labels
    if source == "auto":
        source = "images" if from_images else "scan"
    if source == "images" and take is not None and from_images:
        scene = RayScene(template.world, template.faces)
        votes = project_labels(template.world, template.normals, scene, take, frame)
        labels = label_vertices(
            template.world, template.faces, template.normals, votes, config.smoothness, config.expansions
        )
    elif source == "scan" and template.labels is not None and (template.labels != NO_LABEL).any():
        labels = known_labels(template.world, template.labels)
    else:
        raise MissingInput(
            "There are no labels that say which part is skin, hair, shoe, upper, lower or outer garment.",
            f"label images of frame {frame}" if config.labels != "scan" else "labels of the scan",
            "Run gw label, which guesses them; or add label images (one PNG per camera with ids "
            f"{label_legend()}), or register a scan with a `label` per vertex.",
        )
    island, share = config.smallest_island_m2, config.smallest_share
    return tidy_labels(template.world, template.faces, labels, GARMENT_LABELS, island, share), source


def add_colors(mesh: dict[str, np.ndarray], scene: RayScene, take: Take | None, frame: int) -> None:
    """Put `colors` and `color_confidence` into a layer mesh: projected where seen, filled elsewhere."""
    if take is not None:
        normals = vertex_normals(mesh["world_vertices"], mesh["faces"])
        colors, confidence = layer_colors(mesh["world_vertices"], normals, mesh["labels"], scene, take, frame)
    else:
        colors = mesh["scan_colors"].astype(np.float32) / np.float32(255)
        confidence = np.float32(0.5) * mesh["scan_seen"].astype(np.float32)
    confidence[mesh["ring"] > 0] = 0
    filled = fill_colors(mesh["vertices"], mesh["faces"], colors, confidence)
    mesh["colors"] = np.rint(255 * filled).astype(np.uint8)
    mesh["color_confidence"] = confidence
    del mesh["scan_colors"], mesh["scan_seen"]


def _report_layers(summary: dict[str, Any], report: Report) -> None:
    report.say("layers: " + ", ".join(summary["layers"]) + f" (labels from {summary['labels_from']})")
    for name, slots in summary["slots"].items():
        if len(slots) > 1:
            report.say(f"{name} is one piece: gw export-garment --layer {name} --slots {','.join(slots)}")


def _summary(
    template: Template,
    labels: np.ndarray,
    source: str,
    layers: dict[str, dict[str, np.ndarray]],
    registered: Artifact,
) -> dict[str, Any]:
    areas = vertex_areas(template.world, template.faces)
    shares = np.bincount(labels, areas, minlength=256) / areas.sum()
    return {
        "layers": list(layers),
        "frame": int(registered.summary["frame"]),
        "take": registered.summary.get("take"),
        "labels_from": source,
        "slots": slots_of(layers),
        "tucked_share": {name: float((mesh["ring"] > 0).mean()) for name, mesh in layers.items()},
        "area_shares": {name: float(shares[label]) for label, name in LABELS.items() if shares[label] > 0},
        "vertices": {name: len(mesh["vertices"]) for name, mesh in layers.items()},
        "colored_share": {
            name: float((mesh["color_confidence"] > 0).mean()) for name, mesh in layers.items()
        },
    }
