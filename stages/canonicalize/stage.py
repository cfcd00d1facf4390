"""Bring the posed template to the canonical pose and the zero shape.

Reads (register-template):
    template.safetensors   vertices (V,3) f32 m world, faces (F,3) i32; colors (V,3) u8, labels (V,) u8 if any
    body.safetensors       the body model
    smpl_params.npz        pose and shape of every frame
Writes:
    template.safetensors   vertices (V,3) f32 m canonical zero-shape, faces (F,3) i32, skin_weights (V,55)
                           f32, shape_directions (V,10,3) f32 m per unit of shape, canonical; colors, labels
    body.safetensors       the same for the body mesh itself
    fields.safetensors     voxel fields of weights and rest-frame shape directions, canonical, subject's shape
    preview.png            the canonical template from front and back
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from stages.canonicalize.config import CanonicalizeConfig
from stages.canonicalize.shape import add_shape, canonical_body, template_shape_directions
from stages.canonicalize.unpose import Tears, Unposed, cut_tears, forward_skin, inverse_skin, unpose
from stages.pipeline import CANONICALIZE, REGISTER_TEMPLATE
from stages.shared.artifacts import Inputs, StageResult, Workspace
from stages.shared.body.model import BodyModel
from stages.shared.body.posed import posed_body, row_transforms
from stages.shared.body.poses import Poses
from stages.shared.fields.body_field import BodyField, FieldConfig, build_body_field
from stages.shared.fields.diffusion import inverse_distance_matrix
from stages.shared.meshes.picture import two_sided_picture
from stages.shared.meshes.topology import vertex_normals
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report

_ABOUT = {
    "vertices": "m canonical zero-shape (V,3)",
    "faces": "vertex numbers (F,3)",
    "skin_weights": "rows sum to 1 (V,55)",
    "shape_directions": "m per unit of shape, canonical (V,10,3)",
    "colors": "sRGB (V,3)",
    "labels": "layer label ids (V,)",
}


def run(
    subject: Path,
    config: CanonicalizeConfig = CanonicalizeConfig(),
    report: Report = SILENT,
    force: bool = False,
) -> StageResult:
    """Canonicalize the registered template of a subject.

    Raises:
        MissingInput: the template has not been registered.
    """
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    inputs: Inputs = {"register-template": registered}
    if done := workspace.reuse(CANONICALIZE, config, inputs, report, force):
        return done
    with workspace.build(CANONICALIZE, config, inputs, force) as build:
        template = registered.arrays("template")
        body = BodyModel.from_arrays(registered.arrays("body"))
        pose = load_poses(registered.file("smpl_params.npz"))[int(registered.summary["frame"])]
        world, faces = template["vertices"].astype(np.float64), template["faces"]
        transforms = row_transforms(body, pose)
        body_vertices, body_directions = canonical_body(body)

        report.step("spreading skinning weights around the body")
        start = start_weights(body, pose, world)
        shaped = add_shape(body_vertices, body_directions, pose.betas)
        around = inverse_skin(world, start, transforms)[0]
        field = spread_body(body, shaped, around, config)

        report.step("inverting the pose")
        unposed = unpose(world, start, transforms, field.weights)
        _, rest_directions = field.sample(unposed.points)
        directions = template_shape_directions(body, unposed.weights, rest_directions, config.shape_removal)
        zero_shape = add_shape(unposed.points, directions, -pose.betas)
        tears = cut_tears(faces, world, unposed.points, config.tear_growth, config.tear_length_m)

        mesh = _arrays(zero_shape, tears.faces, unposed.weights, directions)
        round_trip = round_trip_residual(mesh, pose, transforms, world)
        mesh |= {name: template[name] for name in ("colors", "labels") if name in template}
        build.write_arrays("template", mesh, _ABOUT)
        build.write_arrays(
            "body", _arrays(body_vertices, body.faces, body.skin_weights, body_directions), _ABOUT
        )
        build.write_arrays("fields", field.to_arrays())
        build.write_picture("preview.png", two_sided_picture(zero_shape, tears.faces, template.get("colors")))
        build.summary(**_summary(unposed, tears, round_trip, field, len(world)))
    _warn(build.artifact.summary, report)
    return StageResult(build.artifact, build.artifact.summary)


def plan(subject: Path, config: CanonicalizeConfig = CanonicalizeConfig()) -> Plan:
    """What `run` would read, write and cost."""
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    nodes = config.resolution**3
    return Plan(
        inputs=[str(registered.path)],
        outputs=[str(workspace.root / CANONICALIZE.name)],
        config=asdict(config),
        seconds=2.0 + nodes * 1e-5,
        memory_bytes=500_000_000 + nodes * 1500,
        disk_bytes=5_000_000 + nodes * 76,
    )


def start_weights(body: BodyModel, pose: Poses, world: np.ndarray) -> np.ndarray:
    """Weights (V, 55) of world points by inverse distance to the posed body: where the inversion starts."""
    matrix, _, _ = inverse_distance_matrix(cKDTree(posed_body(body, pose)), world)
    return matrix @ body.skin_weights.astype(np.float64)


def spread_body(
    body: BodyModel, shaped: np.ndarray, around: np.ndarray, config: CanonicalizeConfig
) -> BodyField:
    """The field around the subject's body (V, 3) in the canonical pose and around template points (P, 3)."""
    field_config = FieldConfig(
        resolution=config.resolution, spread=config.spread, reach_per_distance=config.reach_per_distance
    )
    normals = vertex_normals(shaped, body.faces)
    return build_body_field(shaped, normals, body.skin_weights, body.shape_directions, around, field_config)


def round_trip_residual(
    mesh: dict[str, np.ndarray], pose: Poses, transforms: np.ndarray, world: np.ndarray
) -> np.ndarray:
    """Distance (V,), metres, between the template and what is stored, shaped and posed back."""
    stored = {
        name: mesh[name].astype(np.float64) for name in ("vertices", "skin_weights", "shape_directions")
    }
    shaped = add_shape(stored["vertices"], stored["shape_directions"], pose.betas)
    return np.linalg.norm(forward_skin(shaped, stored["skin_weights"], transforms) - world, axis=1)


def _arrays(
    vertices: np.ndarray, faces: np.ndarray, weights: np.ndarray, directions: np.ndarray
) -> dict[str, np.ndarray]:
    """A canonical mesh as it is written."""
    return {
        "vertices": vertices.astype(np.float32),
        "faces": faces.astype(np.int32),
        "skin_weights": weights.astype(np.float32),
        "shape_directions": directions.astype(np.float32),
    }


def _summary(
    unposed: Unposed, tears: Tears, round_trip: np.ndarray, field: BodyField, vertices: int
) -> dict[str, Any]:
    return {
        "vertices": vertices,
        "faces": len(tears.faces),
        "residual_max_m": float(round_trip.max()),
        "residual_p95_m": float(np.percentile(round_trip, 95)),
        "requeried_residual_max_m": float(unposed.requeried_residual.max()),
        "requeried_residual_p95_m": float(np.percentile(unposed.requeried_residual, 95)),
        "blended_inverse_vertices": unposed.blended_inverse,
        "torn_edges": tears.torn_edges,
        "cut_faces": tears.cut_faces,
        "largest_edge_growth": tears.largest_growth,
        "field_nodes": len(field.field.values),
    }


def _warn(summary: dict[str, Any], report: Report) -> None:
    if summary["cut_faces"]:
        report.warn(
            f"{summary['torn_edges']} edges were torn by the change of pose; {summary['cut_faces']} faces cut"
        )
    if summary["residual_max_m"] > 1e-5:
        report.warn(f"posing the template back misses it by up to {1e3 * summary['residual_max_m']:.3g} mm")
