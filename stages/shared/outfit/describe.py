"""What a bundle is, for people: one table, and what fits what."""

from __future__ import annotations

from typing import Any

from stages.shared.artifacts.bundle import BundleCard
from stages.shared.avatar.decoders.components import bytes_by_component

_BYTES = {"F32": 4, "F16": 2, "I32": 4, "U8": 1}
_SCORES = ("psnr", "psnr_foreground", "ssim", "iou", "miou", "steps", "seconds")


def describe(card: BundleCard) -> dict[str, Any]:
    """Kind, slots, size, what it was made with and how good it is; plain JSON."""
    manifest = card.manifest
    groups: dict[str, int] = {}
    model: dict[str, int] = {}
    for name, (dtype, shape) in card.tensors.items():
        size = _BYTES[dtype]
        for side in shape:
            size *= side
        group, _, part = name.partition("/")
        groups[group] = groups.get(group, 0) + size
        if group == "model":
            model[part] = size
    scores = manifest["training"].get("scores", {})
    schema = manifest["schema"]
    return {
        "kind": manifest["kind"],
        "layer": manifest["layer"],
        "slots": list(manifest["slots"]),
        "schema": f"{schema['major']}.{schema['minor']}",
        "digest": card.digest,
        "bytes": card.bytes,
        "bytes_by_group": dict(sorted(groups.items())),
        "multiply_adds_per_frame": _costs(manifest).get("multiply_adds_per_frame", {}),
        "model_bytes_by_component": bytes_by_component(model),
        "joints_followed": _costs(manifest).get("joints"),
        "gaussians": card.tensors["maps/texels"][1][0],
        "millimetres_per_texel": round(1000 * manifest["grid"]["pitch"], 3),
        "decoder": manifest["model"].get("kind") or manifest["model"].get("decoder") or "network",
        "half_precision": any(dtype == "F16" for dtype, _ in card.tensors.values()),
        "body_model": manifest["body_model"]["digest"],
        "carries_body_beneath": "swap/texels" in card.tensors,
        "carries_bare_skin": "skin/covered" in card.tensors,
        "unobserved_share": manifest.get("unobserved_share", 0.0),
        "converts_to_other_body_models": "joints" in card.tensors,
        "source": str(manifest["training"].get("source", "")),
        "scores": {name: scores[name] for name in _SCORES if isinstance(scores.get(name), int | float)},
        "note": manifest["note"],
    }


def _costs(manifest: dict[str, Any]) -> dict[str, Any]:
    """What the export counted; {} of bundles that are older."""
    found = manifest.get("costs")
    return found if isinstance(found, dict) else {}


def fit(garment: BundleCard, body: BundleCard) -> str:
    """How a garment goes on a body: "own", "fits", "converted", or "no": another body model and no bones."""
    if garment.manifest["body_model"]["digest"] == body.manifest["body_model"]["digest"]:
        source = garment.manifest["training"].get("source")
        return "own" if source and source == body.manifest["training"].get("source") else "fits"
    return "converted" if "joints" in garment.tensors else "no"
