"""The template mesh of one layer as skinned glTF, for Blender and engines.

Reads:
    register-template: `body.safetensors` body model; `smpl_params.npz` betas and poses.
    segment-layers: `<layer>.safetensors` mesh, skin weights, shape directions, colours.
    bake-maps, train: maps and learned colours of the layer, for the texture, where these stages have run.
Writes:
    one `.glb` (canonical pose, metres, 55 joints, a texture where there are maps) and `NAME.glb.notes.json`
    about frame, units and losses.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stages.export_garment.config import TemplateMeshConfig
from stages.export_garment.preview import canonical_composite
from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE, SEGMENT_LAYERS, TRAIN
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import BodyModel
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.export.notes import write_notes
from stages.shared.export.skinned_mesh import SkinnedMesh, write_skinned_glb
from stages.shared.export.texture import MeshTexture, mesh_texture
from stages.shared.outfit.layer import layer_of_training
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_file_target


def run(
    subject: Path,
    output: Path,
    config: TemplateMeshConfig = TemplateMeshConfig(),
    poses: Path | None = None,
    report: Report = SILENT,
) -> dict[str, Any]:
    """Write mesh and skeleton; returns path, layer, vertices, faces, frames of the animation.

    Arguments:
        poses: a motion to carry along as an animation of the joints; None for none.

    Raises:
        UsageProblem: the file is not called .glb, or weights_per_vertex is not 4 or 8.
        MissingInput: a stage has not run, there is no such layer. BadData: the pose file.
        StorageFailure: disk full; nothing half-written is left.
    """
    registered, segmented = _open(subject, output, config)
    report.step(f"exporting the mesh of {config.layer}")
    body = BodyModel.from_arrays(registered.arrays("body.safetensors"))
    arrays = segmented.arrays(f"{config.layer}.safetensors")
    texture = _texture(Workspace(subject), config.layer, arrays) if config.texture else None
    mesh = SkinnedMesh(
        config.layer,
        arrays["vertices"],
        arrays["faces"],
        arrays["skin_weights"],
        arrays["shape_directions"],
        arrays["colors"],
        texture,
    )
    motion = None if poses is None else load_poses(poses, body, report=report)
    betas = np.zeros(10, np.float32)
    if config.own_shape:
        betas = load_poses(registered.file("smpl_params.npz"), body).betas
    write_skinned_glb(output, mesh, body, betas, motion, config.weights_per_vertex)
    write_notes(
        output.with_name(output.name + ".notes.json"),
        "mesh",
        "canonical pose" + ("" if config.own_shape else ", zero shape"),
        layer=config.layer,
        betas=betas,
    )
    return {
        "mesh": str(output),
        "layer": config.layer,
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "frames": 0 if motion is None else len(motion),
        "texture_pixels": [] if texture is None else list(texture.image.shape[1::-1]),
    }


def plan(
    subject: Path,
    output: Path,
    config: TemplateMeshConfig = TemplateMeshConfig(),
    poses: Path | None = None,
) -> Plan:
    """What `run` would read, write and cost."""
    registered, segmented = _open(subject, output, config)
    if poses is not None:
        load_poses(poses, BodyModel.from_arrays(registered.arrays("body.safetensors")))
    size = segmented.file(f"{config.layer}.safetensors").stat().st_size
    return Plan(
        inputs=[str(registered.path), str(segmented.path)],
        outputs=[str(output), f"{output}.notes.json"],
        config=asdict(config),
        seconds=2.0,
        memory_bytes=200_000_000 + 4 * size,
        disk_bytes=size // 4,
    )


def _texture(workspace: Workspace, layer: str, mesh: dict[str, np.ndarray]) -> MeshTexture | None:
    """The texels' learned colours, or those of bake-maps before a training; None without maps."""
    baked, trained = workspace.current(BAKE_MAPS), workspace.current(TRAIN)
    if baked is None:
        return None
    if trained is not None and layer in trained.json("model.json")["layers"]:
        worn = layer_of_training(layer, baked, trained)
        maps, colors = worn.maps, canonical_composite(worn).features[:, :3].numpy()
    else:
        maps = LayerMaps.load(baked, layer)
        colors = maps.colors.numpy()
    return mesh_texture(maps, colors, mesh["vertices"], mesh["faces"])


def _open(subject: Path, output: Path, config: TemplateMeshConfig) -> tuple[Artifact, Artifact]:
    if output.suffix != ".glb":
        raise UsageProblem("The mesh is written as .glb.", str(output), "Name it so, as --mesh skirt.glb.")
    check_file_target(output, "--mesh skirt.glb")
    if config.weights_per_vertex not in (4, 8):
        raise UsageProblem("A vertex has 4 or 8 weights.", "option --weights-per-vertex", "Give 4 or 8.")
    workspace = Workspace(subject)
    registered, segmented = workspace.require(REGISTER_TEMPLATE), workspace.require(SEGMENT_LAYERS)
    names = segmented.summary["layers"]
    if config.layer not in names:
        raise MissingInput(
            f"This subject has no layer {config.layer!r}.",
            str(subject),
            "Choose of: " + ", ".join(names) + ".",
        )
    return registered, segmented
