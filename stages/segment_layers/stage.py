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
from stages.segment_layers.extract import join
from stages.segment_layers.fill import fill_colors
from stages.segment_layers.layers import Template, body_layer, body_surface, garment_layer, slots_of
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.artifacts.result import StageResult
from stages.shared.body.model import BodyModel
from stages.shared.capture import Take, label_picture
from stages.shared.capture.layer_colors import has_label_images, layer_colors
from stages.shared.capture.projection import project_labels
from stages.shared.capture.template_views import frame_files, template_take
from stages.shared.errors import MissingInput
from stages.shared.layers import BODY, GARMENT_LABELS, LABELS, LAYER_OF_LABEL, NO_LABEL, label_legend
from stages.shared.meshes.labelling import known_labels, label_vertices, tidy_labels
from stages.shared.meshes.picture import two_sided_picture
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.regions import vertex_areas
from stages.shared.meshes.topology import vertex_normals
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
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
    body = BodyModel.from_arrays(registered.arrays("body"))
    capture, take = template_take(workspace, registered)
    frame = int(registered.summary["frame"])
    inputs: dict[str, Artifact | ExternalFiles] = {
        "register-template": registered,
        "canonicalize": canonical,
        **frame_files(capture, take, frame),
    }
    found = None if force else workspace.find(SEGMENT_LAYERS, config, inputs)
    if found:
        report.say("segment-layers is up to date")
        return StageResult(found, found.summary)
    with workspace.build(SEGMENT_LAYERS, config, inputs, force) as build:
        template = Template.load(registered.arrays("template"), canonical.arrays("template"))
        pose = load_poses(registered.file("smpl_params.npz"))[frame]

        report.step("labelling the template")
        labels, source = choose_labels(template, take, frame, config)

        report.step("cutting out the layers")
        canonical_body = canonical.arrays("body")
        surface = body_surface(canonical_body, body, pose)
        garments = {
            LAYER_OF_LABEL[label]: garment_layer(template, labels, label, config, surface)
            for label in GARMENT_LABELS
        }
        layers = {BODY: body_layer(template, labels, canonical_body, body, pose)}
        layers |= {name: mesh for name, mesh in garments.items() if len(mesh["faces"])}

        report.step("projecting colours")
        scene = RayScene(*_scene_mesh(layers))
        for name, mesh in layers.items():
            add_colors(mesh, scene, take, frame)
            build.write_arrays(name, mesh, _ABOUT)
        build.write_arrays(
            "labels", {"labels": labels}, {"labels": "layer label ids of template vertices (V,)"}
        )
        build.write_picture("preview.png", _preview(template, labels))
        build.summary(**_summary(template, labels, source, layers, registered))
    summary = build.artifact.summary
    report.say("layers: " + ", ".join(summary["layers"]) + f" (labels from {source})")
    for name, slots in summary["slots"].items():
        if len(slots) > 1:
            report.say(f"{name} is one piece: gw export-garment --layer {name} --slots {','.join(slots)}")
    return StageResult(build.artifact, summary)


def plan(subject: Path, config: SegmentLayersConfig = SegmentLayersConfig()) -> Plan:
    """What `run` would read, write and cost."""
    workspace = Workspace(subject)
    registered, canonical = workspace.require(REGISTER_TEMPLATE), workspace.require(CANONICALIZE)
    inputs = [str(registered.path), str(canonical.path)]
    if workspace.settings().get("capture"):
        inputs.append(str(workspace.setting_path("capture")))
    vertices = int(canonical.summary["vertices"])
    return Plan(
        inputs=inputs,
        outputs=[str(workspace.root / SEGMENT_LAYERS.name)],
        config=asdict(config),
        seconds=1.0 + vertices * 7e-5,
        memory_bytes=600_000_000 + vertices * 4000,
        disk_bytes=3_000_000 + vertices * 370,
    )


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
        votes = project_labels(
            template.world, template.normals, RayScene(template.world, template.faces), take, frame
        )
        labels = label_vertices(
            template.world,
            template.faces,
            template.normals,
            votes,
            GARMENT_LABELS,
            config.smoothness,
            config.expansions,
            config.smallest_island_m2,
            config.smallest_share,
        )
        return labels, source
    if source == "scan" and template.labels is not None and (template.labels != NO_LABEL).any():
        known = known_labels(template.world, template.labels)
        tidy = tidy_labels(
            template.world,
            template.faces,
            known,
            GARMENT_LABELS,
            config.smallest_island_m2,
            config.smallest_share,
        )
        return tidy, source
    raise MissingInput(
        "There are no labels that say which part is skin, hair, shoe, upper, lower or outer garment.",
        f"label images of frame {frame}" if config.labels != "scan" else "labels of the scan",
        f"Add label images (one PNG per camera with ids {label_legend()}), "
        "or register a scan with a `label` per vertex.",
    )


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


def _scene_mesh(layers: dict[str, dict[str, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    parts = [{"vertices": mesh["world_vertices"], "faces": mesh["faces"]} for mesh in layers.values()]
    everything = join(parts)
    return everything["vertices"], everything["faces"]


def _preview(template: Template, labels: np.ndarray) -> np.ndarray:
    return two_sided_picture(template.canonical["vertices"], template.faces, label_picture(labels))


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
