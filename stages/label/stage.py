"""Label the template's surface without label images: a guess from body, colours and strokes.

Reads:
    register-template   template.safetensors (vertices (V,3) m world, faces), body.safetensors,
                        smpl_params.npz
    capture             images and masks of the template's frame, training cameras
Writes:
    labels.safetensors  labels (V,) u8 ids of the template's vertices
    images/<take>/<camera>/<frame>.png   label images of the template's frame, training cameras; from now on
                        every stage of this subject reads them in place of the capture's
    strokes.json        the strokes that were applied
    preview.png         the template in label colours, front and back
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.label.config import LabelConfig
from stages.label.guess import Guess, Surface, guess_labels
from stages.label.place import place_shares
from stages.label.strokes import FORMAT, stroke_labels
from stages.pipeline import LABEL, REGISTER_TEMPLATE
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.artifacts.spec import StageResult
from stages.shared.body.model import BodyModel
from stages.shared.capture import Take, label_picture
from stages.shared.capture.projection import project_colors
from stages.shared.capture.subject import LABELS_SETTING
from stages.shared.capture.take import MASK_THRESHOLD
from stages.shared.capture.template_views import frame_files, template_take
from stages.shared.errors import MissingInput
from stages.shared.layers import LABELS, NO_LABEL
from stages.shared.meshes.picture import two_sided_picture
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.regions import vertex_areas
from stages.shared.meshes.topology import vertex_normals
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report

IMAGES = "images"


def run(
    subject: Path, config: LabelConfig = LabelConfig(), report: Report = SILENT, force: bool = False
) -> StageResult:
    """Label the template of a subject.

    Raises:
        MissingInput: register-template has not run, or the subject was made from a mesh.
        BadData, UsageProblem: a stroke names no camera, or does not touch the person.
    """
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    take, frame, inputs = _sources(workspace, registered)
    artifact = None if force else workspace.find(LABEL, config, inputs)
    if artifact:
        report.say("label is up to date")
    else:
        with workspace.build(LABEL, config, inputs, force) as build:
            report.step("projecting colours")
            surface = _surface(registered, take, frame, config)
            report.step("labelling the template")
            guess = guess_labels(surface, config)
            report.step("drawing label images")
            for name, picture in _label_images(surface, guess.labels, take, frame).items():
                build.write_picture(f"{IMAGES}/{take.name}/{name}/{frame:06d}.png", picture)
            build.write_arrays("labels", {"labels": guess.labels}, {"labels": "layer label ids (V,)"})
            build.write_json("strokes.json", _stroke_file(config))
            preview = label_picture(guess.labels)
            build.write_picture("preview.png", two_sided_picture(surface.vertices, surface.faces, preview))
            build.summary(**_summary(surface, guess, config, take, frame))
        artifact = build.artifact
    workspace.save_settings(**{LABELS_SETTING: artifact.path / IMAGES})
    shares = artifact.summary["area_shares"]
    report.say("labels: " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items()))
    return StageResult(artifact, artifact.summary)


def plan(subject: Path, config: LabelConfig = LabelConfig()) -> Plan:
    """What `run` would read, write and cost."""
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    take, _, inputs = _sources(workspace, registered)
    vertices = int(registered.summary["vertices"])
    return Plan(
        inputs=[str(part.path if isinstance(part, Artifact) else part.root) for part in inputs.values()],
        outputs=[str(workspace.root / LABEL.name)],
        config=asdict(config),
        seconds=1.0 + 5e-6 * vertices * (10 + len(take.training_cameras)),
        memory_bytes=600_000_000 + vertices * 4000,
        disk_bytes=100_000 + 10_000 * len(take.training_cameras),
    )


def _sources(
    workspace: Workspace, registered: Artifact
) -> tuple[Take, int, dict[str, Artifact | ExternalFiles]]:
    """The template's take and frame, and what is read. Existing labels are not read."""
    capture, take = template_take(workspace, registered)
    if capture is None or take is None:
        raise MissingInput(
            "This subject was made from a mesh; no picture shows it.",
            str(workspace.root),
            "Give the mesh a `label` per vertex, or register a capture.",
        )
    frame = int(registered.summary["frame"])
    files = frame_files(capture, take, frame)
    inputs: dict[str, Artifact | ExternalFiles] = {"register-template": registered}
    inputs |= {name: group for name, group in files.items() if "labels" not in name}
    return take, frame, inputs


def _surface(registered: Artifact, take: Take, frame: int, config: LabelConfig) -> Surface:
    template = registered.arrays("template")
    vertices, faces = template["vertices"].astype(np.float64), template["faces"]
    normals = vertex_normals(vertices, faces).astype(np.float64)
    scene = RayScene(vertices, faces)
    strokes = stroke_labels(config.strokes, vertices, normals, scene, take)
    colors, confidence = project_colors(vertices, normals, scene, take, frame)
    pose = load_poses(registered.file("smpl_params.npz"))[frame]
    shares = place_shares(vertices, BodyModel.from_arrays(registered.arrays("body")), pose)
    return Surface(vertices, normals, faces, colors, confidence, shares, strokes)


def _label_images(
    surface: Surface, labels: NDArray[np.uint8], take: Take, frame: int
) -> dict[str, NDArray[np.uint8]]:
    """Label images (H, W) u8 by camera: the surface as the camera sees it, within the mask.

    Pixels of the mask beside the surface take the nearest label.
    """
    scene = RayScene(surface.vertices, surface.faces)
    pictures = {}
    for name in take.training_cameras:
        if not take.has_image(name, frame):
            continue
        picture = scene.render(take.camera(name)).largest_corner(surface.faces, labels, NO_LABEL)
        missing = (picture == NO_LABEL).astype(np.uint8)
        if not missing.all():
            _, nearest = cv2.distanceTransformWithLabels(
                missing, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
            )
            by_number = np.zeros(int(nearest.max()) + 1, np.uint8)
            by_number[nearest[missing == 0]] = picture[missing == 0]
            picture = by_number[nearest]
        inside = take.mask(name, frame) > MASK_THRESHOLD
        pictures[name] = np.where(inside, picture, NO_LABEL).astype(np.uint8)
    return pictures


def _stroke_file(config: LabelConfig) -> dict[str, Any]:
    strokes = [asdict(stroke) | {"label": LABELS[stroke.label]} for stroke in config.strokes]
    strokes = [{key: value for key, value in stroke.items() if value is not None} for stroke in strokes]
    return {"format": FORMAT, "version": 1, "strokes": strokes}


def _summary(surface: Surface, guess: Guess, config: LabelConfig, take: Take, frame: int) -> dict[str, Any]:
    areas = vertex_areas(surface.vertices, surface.faces)
    shares = np.bincount(guess.labels, areas, minlength=len(LABELS)) / areas.sum()
    return {
        "take": take.name,
        "frame": frame,
        "strokes": len(config.strokes),
        "bare": [LABELS[label] for label in guess.bare],
        "area_shares": {LABELS[label]: float(share) for label, share in enumerate(shares) if share > 0},
        "seen_share": float(areas[surface.confidence > 0].sum() / areas.sum()),
    }
