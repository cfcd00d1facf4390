"""Which part of a model a stored tensor belongs to; light."""

from __future__ import annotations

from collections.abc import Mapping

_TENSORS = {
    "base_": "base attributes",
    "observed": "base attributes",
    "networks": "networks",
    "view_net": "networks",
    "input_": "positional map",
    "anchors": "anchors",
    "fading": "anchors",
    "motion_scale": "anchors",
    "basis_": "blendshapes",
    "mean_residual": "mean residual",
    "coefficients": "pose coefficients",
    "prior": "pose prior",
}


def component_of(tensor: str) -> str:
    """What part of a model a stored tensor belongs to."""
    first = tensor.split(".")[0]
    for begin, name in _TENSORS.items():
        if first.startswith(begin):
            return name
    return "other"


def bytes_by_component(sizes: Mapping[str, int]) -> dict[str, int]:
    """Bytes of a model's stored tensors (name to bytes), summed by component."""
    found: dict[str, int] = {}
    for name, size in sizes.items():
        part = component_of(name)
        found[part] = found.get(part, 0) + size
    return dict(sorted(found.items()))
