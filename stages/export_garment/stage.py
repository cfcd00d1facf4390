"""Export one trained layer as a wardrobe bundle (`.gwg`).

Reads:
    register-template: `body.safetensors` body model; `smpl_params.npz` betas and poses.
    bake-maps: `<layer>.safetensors`. train, or distill: `<layer>.safetensors`, `model.json`.
    fit-cloth, when it has run: `<layer>.safetensors`, `cloth.json`.
Writes:
    one `.gwg` file: maps, model, betas, joints, preview; a body also its body model and what its covered skin
    is when bare; a garment also the form of the source's body beneath it (offsets (K,3) m and quaternions
    (K,4) per covered texel), and its simulation mesh, pins and material.
    No dates, no paths: two exports of the same training are the same bytes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.export_garment.body_form import covered_skin, form_beneath, mean_attributes
from stages.export_garment.config import ExportGarmentConfig
from stages.export_garment.preview import preview_picture
from stages.pipeline import SEGMENT_LAYERS
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.bundle import Bundle, write_bundle
from stages.shared.artifacts.bundle_precision import PRECISIONS, halved
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.cost import costs
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import BodyModel, Poses
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import BODY, LAYERS, SLOTS, garments_of
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.retarget import canonical_joints
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_file_target

_UNITS = {"length": "metre", "angle": "radian", "color": "sRGB 0..1"}
_FRAMES = {
    "maps": "canonical pose (hips +-25 degrees about z, wrists -90 about x), zero shape, y up, facing +z",
    "model": "StyleUNetDecoder: base attributes per texel and networks on the posed positional map",
}
# Of the body model, what posing Gaussians and reading pose files needs; correctives are left out.
_BODY_ARRAYS = (
    "template_vertices",
    "faces",
    "shape_directions",
    "joint_regressor",
    "skin_weights",
    "hand_components_left",
    "hand_components_right",
    "hand_mean_left",
    "hand_mean_right",
)


@dataclass(frozen=True)
class ExportGarmentResult:
    """The file, the digest that names its content, and a few numbers."""

    path: Path
    digest: str
    summary: dict[str, Any]


def run(
    subject: Path,
    output: Path,
    config: ExportGarmentConfig = ExportGarmentConfig(),
    report: Report = SILENT,
) -> ExportGarmentResult:
    """Write the bundle of one layer to `output`.

    Raises:
        MissingInput: a stage has not run, or the subject has no such layer. UsageProblem: impossible slots.
        StorageFailure: disk full; nothing half-written is left.
    """
    config = replace(config, slots=checked_slots(config) if config.slots else own_slots(subject, config))
    source = _open_layer(subject, output, config)
    names = _layers(source)
    report.step(f"exporting {config.layer}")
    body, poses = source.body_model(), source.poses()
    layer = source.layer(config.layer)
    arrays = {f"maps/{name}": array for name, array in layer.maps.arrays().items()}
    arrays |= {f"model/{name}": tensor.numpy() for name, tensor in layer.model.state().items()}
    arrays |= _about_body(config, source, names, layer, body, poses)
    if layer.cloth is not None:
        arrays |= {f"cloth/{name}": array for name, array in layer.cloth.arrays().items()}
    arrays["preview"] = preview_picture(layer, config.preview_size)
    manifest = _manifest(config, layer, source, body.digest)
    digest = write_bundle(
        output, Bundle(manifest, halved(arrays) if config.precision == "float16" else arrays)
    )
    size = output.stat().st_size
    report.say(f"{output}: {len(layer.maps)} Gaussians, {size / 2**20:.1f} MiB")
    summary = {
        "layer": config.layer,
        "slots": list(config.slots),
        "gaussians": len(layer.maps),
        "bytes": size,
        "digest": digest,
    }
    return ExportGarmentResult(output, digest, summary)


def plan(subject: Path, output: Path, config: ExportGarmentConfig = ExportGarmentConfig()) -> Plan:
    """What `run` would read, write and cost."""
    checked_slots(config)
    source = _open_layer(subject, output, config)
    texels = int(source.baked.summary["texels"].get(config.layer, 0))
    return Plan(
        inputs=[str(part.path) for part in (source.registered, source.baked, source.trained)],
        outputs=[str(output)],
        config=asdict(config),
        seconds=3.0,
        memory_bytes=400_000_000 + 2000 * texels,
        disk_bytes=500 * texels + (9_000_000 if config.layer == BODY else 1_000_000),
    )


def _open_layer(subject: Path, output: Path, config: ExportGarmentConfig) -> TrainedSubject:
    """The artifacts of a subject that has the layer, for a file that can be written."""
    check_file_target(output, f"-o {config.layer}.gwg")
    source = TrainedSubject.open(subject, config.distilled)
    names = _layers(source)
    if config.layer not in names:
        raise MissingInput(
            f"This subject has no layer {config.layer!r}.",
            str(subject),
            "Choose one of: " + ", ".join(names) + "." if names else "Train it in layers: gw train.",
        )
    return source


def own_slots(subject: Path, config: ExportGarmentConfig) -> tuple[str, ...]:
    """What `gw segment-layers` found a garment to cover (a dress: lower and upper), else its own layer."""
    segmented = Workspace(subject).current(SEGMENT_LAYERS)
    found = segmented.summary.get("slots", {}) if segmented is not None else {}
    return checked_slots(replace(config, slots=tuple(found.get(config.layer, ()))))


def checked_slots(config: ExportGarmentConfig) -> tuple[str, ...]:
    """The slots of a bundle, inner to outer: those asked for, or the layer's own.

    Raises:
        UsageProblem: no such layer or slot, or slots without the layer itself.
    """
    if config.precision not in PRECISIONS:
        raise UsageProblem(
            f"There is no precision called {config.precision!r}.",
            "option --precision",
            "Choose " + " or ".join(PRECISIONS) + ".",
        )
    if config.layer not in LAYERS:
        raise UsageProblem(
            f"There is no layer called {config.layer!r}.",
            "option --layer",
            "Choose " + ", ".join(LAYERS) + ".",
        )
    if config.layer == BODY:
        if config.slots:
            raise UsageProblem("A body takes no slots.", "option --slots", "Leave --slots out.")
        return ()
    slots = config.slots or (config.layer,)
    unknown = [slot for slot in slots if slot not in SLOTS]
    if unknown or config.layer not in slots:
        raise UsageProblem(
            f"A garment of the layer {config.layer} cannot take the slots {', '.join(slots)}.",
            "option --slots",
            f"Name {config.layer} and whatever else it covers of {', '.join(SLOTS)}.",
        )
    return tuple(slot for slot in SLOTS if slot in slots)


def _about_body(
    config: ExportGarmentConfig,
    source: TrainedSubject,
    names: list[str],
    layer: WornLayer,
    body_model: BodyModel,
    poses: Poses,
) -> dict[str, np.ndarray]:
    """Shape and joints of the person; of a garment the body beneath it; of a body its model and its skin."""
    rest = canonical_joints(body_model)
    arrays = {"betas": poses.betas, "joints": rest}
    if config.layer == BODY:
        arrays |= {f"body/{k}": v for k, v in body_model.to_arrays().items() if k in _BODY_ARRAYS}
        garments = [source.layer(name) for name in garments_of(names)]
        mean = mean_attributes(layer, body_model, poses, config.beneath_frames)
        return arrays | covered_skin(layer, garments, mean)
    if config.beneath and BODY in names:
        body = source.layer(BODY)
        arrays |= form_beneath(layer, body, mean_attributes(body, body_model, poses, config.beneath_frames))
    return arrays


def _layers(source: TrainedSubject) -> list[str]:
    return [name for name in source.layers if name in LAYERS]


def _unobserved(model: Decoder) -> dict[str, float]:
    """The share of texels that no training picture showed, whose fabric was filled in; {} for none."""
    if model.all_observed:
        return {}
    return {"unobserved_share": round(float((model.observed < 1).float().mean()), 4)}


def _manifest(
    config: ExportGarmentConfig, layer: WornLayer, source: TrainedSubject, body_digest: str
) -> dict[str, Any]:
    maps: LayerMaps = layer.maps
    return {
        "kind": "body" if config.layer == BODY else "garment",
        "layer": config.layer,
        "slots": list(config.slots),
        "body_model": {"digest": body_digest, "convention": "SMPL-X", "joints": 55, "betas": 10},
        "grid": {"pitch": maps.pitch, "centre": list(maps.centre), "size": maps.grid_size},
        "units": _UNITS,
        "frames": _FRAMES,
        "model": layer.model.config,
        "training": {
            "source": source.trained.digest,
            "config": source.trained.config,
            "scores": source.trained.summary,
        },
        "costs": costs(layer.model),
        **_unobserved(layer.model),
        "note": config.note,
        **_cloth_entry(layer),
    }


def _cloth_entry(layer: WornLayer) -> dict[str, Any]:
    """Material and default driver of a garment that can be simulated."""
    if layer.cloth is None:
        return {}
    return {"cloth": {"material": layer.cloth.material.to_json(), "drive": layer.drive}}
