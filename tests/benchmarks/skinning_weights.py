"""Ways to spread skinning weights, side by side: how each tears the template and how it moves it.

The comparison of Gaussian Wardrobe's supplement (nearest-vertex weights against diffused ones, at the
armpits) as numbers and a picture.

Reads:
    register-template   as `gw canonicalize`
    capture             masks and poses of the test takes, if there are any
Writes, into a folder:
    compare.json        {"variants": {name: numbers}}
    compare.png         the canonical template and its armpits, one column per variant; red where edges have
                        grown fivefold or more
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from scipy.spatial import cKDTree

from gw_cli.console import Console
from gw_cli.options import Json, Preset, Subject
from stages.canonicalize.config import PRESETS, CanonicalizeConfig
from stages.canonicalize.shape import add_shape, canonical_body
from stages.canonicalize.stage import spread_body, start_weights
from stages.canonicalize.unpose import cut_tears, edge_growth, forward_skin, inverse_skin, unpose
from stages.pipeline import REGISTER_TEMPLATE
from stages.shared.artifacts import Workspace, write_whole
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.pictures import encode_png
from stages.shared.body.canonical import canonical_from_rest
from stages.shared.body.kinematics import shaped_joints
from stages.shared.body.model import BodyModel
from stages.shared.body.posed import posed_body, row_transforms
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import JOINT_INDEX
from stages.shared.capture.outlines import filmed_frames, outline_agreement
from stages.shared.capture.subject import open_subject_capture
from stages.shared.capture.take import Take
from stages.shared.meshes.picture import two_sided_picture
from stages.shared.meshes.topology import face_normals
from stages.shared.pictures.sheet import contact_sheet
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report
from tests.benchmarks.command import application

VARIANTS = {
    "nearest": "weights of the nearest body vertex",
    "undiffused": "inverse distance to 30 body vertices, not diffused",
    "diffused": "the voxel field, diffused",
}
_SHOULDERS = (JOINT_INDEX["left_shoulder"], JOINT_INDEX["right_shoulder"])
_ARMPIT = 0.16  # metres around a shoulder joint
_GREY, _RED = np.array([190.0, 190.0, 190.0]), np.array([220.0, 30.0, 30.0])


@dataclass(frozen=True)
class CompareResult:
    """The folder, and the numbers of every variant."""

    path: Path
    summary: dict[str, Any]


def run(
    subject: Path,
    output: Path,
    config: CanonicalizeConfig = CanonicalizeConfig(),
    report: Report = SILENT,
    camera_step: int = 2,
) -> CompareResult:
    """Compare the variants on a subject's registered template.

    Raises:
        MissingInput: the template has not been registered.
    """
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    template = registered.arrays("template")
    body = BodyModel.from_arrays(registered.arrays("body"))
    pose = load_poses(registered.file("smpl_params.npz"))[int(registered.summary["frame"])]
    world, faces = template["vertices"].astype(np.float64), template["faces"]
    transforms = row_transforms(body, pose)
    takes: tuple[Take, ...] = ()
    if workspace.settings().get("capture"):
        takes = open_subject_capture(workspace, body).test_takes
    armpits = _armpits(body, pose)
    found, pictures = {}, []
    for name in VARIANTS:
        report.step(f"unposing with {name} weights")
        points, weights = _unposed(name, body, pose, world, transforms, config)
        near = _near(points, armpits)
        numbers: dict[str, float | None] = {}
        numbers |= _tearing(world, points, weights, transforms, faces, near, config)
        numbers |= _motion(body, points, weights, world, faces, takes, camera_step)
        found[name] = numbers
        pictures += _pictures(world, points, faces, armpits, config)
    captions = [f"{name}: {part}" for name in VARIANTS for part in ("whole", "armpit")]
    order = [*range(0, len(pictures), 2), *range(1, len(pictures), 2)]
    sheet = contact_sheet([pictures[i] for i in order], len(VARIANTS), [captions[i] for i in order])
    write_whole(output / "compare.png", encode_png(sheet))
    summary = {"variants": found, "about": VARIANTS}
    write_whole(output / "compare.json", readable_json(summary))
    return CompareResult(output, summary)


def _unposed(
    name: str,
    body: BodyModel,
    pose: Poses,
    world: np.ndarray,
    transforms: np.ndarray,
    config: CanonicalizeConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Canonical points (V, 3), subject's shape, and the weights (V, 55) that lead there."""
    start = start_weights(body, pose, world)
    if name == "nearest":
        start = body.skin_weights.astype(np.float64)[cKDTree(posed_body(body, pose)).query(world)[1]]
    if name != "diffused":
        return inverse_skin(world, start, transforms)[0], start
    shaped = add_shape(*canonical_body(body), pose.betas)
    around = inverse_skin(world, start, transforms)[0]
    field = spread_body(body, shaped, around, replace(config, spread="wide"))
    unposed = unpose(world, start, transforms, field.weights)
    return unposed.points, unposed.weights


def _tearing(
    world: np.ndarray,
    points: np.ndarray,
    weights: np.ndarray,
    transforms: np.ndarray,
    faces: np.ndarray,
    near: np.ndarray,
    config: CanonicalizeConfig,
) -> dict[str, float | None]:
    """Growth of edges from the world to the canonical pose, and faces that have turned over."""
    tears = cut_tears(faces, world, points, config.tear_growth, config.tear_length_m)
    growth = edge_growth(faces, world, points, config.tear_length_m)
    here = near[faces].all(axis=1)
    over = _turned_over(world, points, weights, transforms, faces)
    return {
        "torn_edges": tears.torn_edges,
        "cut_faces": tears.cut_faces,
        "largest_edge_growth": tears.largest_growth,
        "armpit_growth_p99": float(np.percentile(growth[here], 99)) if here.any() else 1.0,
        "armpit_torn_faces": int((growth[here].max(axis=1, initial=0.0) > config.tear_growth).sum()),
        "turned_over_faces": int(over.sum()),
        "armpit_turned_over_faces": int(over[here].sum()),
    }


def _turned_over(
    world: np.ndarray, points: np.ndarray, weights: np.ndarray, transforms: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """(F,) faces whose canonical normal, carried by their bones, opposes their normal in the world."""
    blended = np.einsum("vj,jab->vab", weights, transforms[:, :3, :3])[faces].mean(axis=1)
    carried = np.einsum("fab,fb->fa", blended, face_normals(points, faces)[0])
    return np.asarray(np.einsum("fa,fa->f", carried, face_normals(world, faces)[0]) < 0)


def _motion(
    body: BodyModel,
    points: np.ndarray,
    weights: np.ndarray,
    world: np.ndarray,
    faces: np.ndarray,
    takes: tuple[Take, ...],
    camera_step: int,
) -> dict[str, float | None]:
    """Silhouette IoU and largest edge stretch of the template moved by its bones in the test takes."""
    if not takes:
        return {"skinned_iou": None, "stretch_p999": None, "largest_stretch": None}
    scores, stretched = [], np.ones(faces.shape)
    for take in takes:

        def posed(frame: int, take: Take = take) -> np.ndarray:
            return forward_skin(points, weights, row_transforms(body, take.poses, frame))

        frames = filmed_frames(take)
        scores += list(
            outline_agreement(posed, faces, take, frames, take.training_cameras[::camera_step]).values()
        )
        for frame in frames:
            stretched = np.maximum(stretched, edge_growth(faces, world, posed(frame), 0.0))
    return {
        "skinned_iou": float(np.mean(scores)) if scores else None,
        "stretch_p999": float(np.percentile(stretched, 99.9)),
        "largest_stretch": float(stretched.max()),
    }


def _pictures(
    world: np.ndarray, points: np.ndarray, faces: np.ndarray, armpits: np.ndarray, config: CanonicalizeConfig
) -> list[np.ndarray]:
    """The whole template, and its left armpit from front and back; red where edges have grown."""
    growth = edge_growth(faces, world, points, config.tear_length_m).max(axis=1)
    share = np.zeros(len(points))
    np.maximum.at(
        share, faces.ravel(), np.repeat(np.clip((growth - 1.5) / (config.tear_growth - 1.5), 0, 1), 3)
    )
    colors = _GREY + share[:, None] * (_RED - _GREY)
    here = _near(points, armpits[:1])[faces].all(axis=1)
    return [
        two_sided_picture(points, faces, colors, height=420),
        two_sided_picture(points, faces[here], colors, height=300),
    ]


def _armpits(body: BodyModel, pose: Poses) -> np.ndarray:
    """(2, 3) shoulder joints in the canonical pose, subject's shape, metres."""
    betas = torch.from_numpy(pose.betas).double()
    joints, moved = shaped_joints(body, betas).numpy(), canonical_from_rest(body, betas).numpy()
    return np.stack([(moved[j] @ np.append(joints[j], 1.0))[:3] for j in _SHOULDERS])


def _near(points: np.ndarray, armpits: np.ndarray) -> np.ndarray:
    """(V,) bool: within reach of an armpit."""
    return np.asarray(cKDTree(armpits).query(points)[0] < _ARMPIT)


def skinning_weights(
    subject: Subject,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder; default: SUBJECT/compare.")
    ] = None,
    preset: Preset = "draft",
    as_json: Json = False,
) -> None:
    """Compare nearest, undiffused and diffused skinning weights on a subject's registered template."""
    console = Console(as_json)
    result = run(subject, output or subject / "compare", PRESETS[preset], console)
    console.result({"path": result.path, **result.summary})


app = application(skinning_weights)

if __name__ == "__main__":
    app()
