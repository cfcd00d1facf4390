"""The layers of a dressed person: their order, the label ids that show them, and which layers touch.

Two tables hold the facts. `_LABELS` lists the classes of a label image from the skin outwards, with the layer
that each class belongs to. `TOUCHING` lists the pairs of layers that lie directly on each other. The body is
a layer but no slot. Every other layer is a slot, and one garment can fill several.

Imports the standard library only, because shell completion and the artifact store read it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple


class Label(NamedTuple):
    """One class of a label image.

    Attributes:
        id: value of a pixel. name: as documentation and error messages call it.
        layer: the layer that shows it.
        color: sRGB 0..255, as 4D-DRESS paints it.
        skin_contact: how closely its surface follows the body, from 0 (loose) to 1 (bare skin).
    """

    id: int
    name: str
    layer: str
    color: tuple[int, int, int]
    skin_contact: float = 0.0


BODY: Final = "body"
WHOLE: Final = "whole"  # of a baseline: the person as one layer
CLOTHING: Final = "clothing"  # of a baseline: all garments as one layer over the body
BASELINE_LAYERS: Final = (CLOTHING, WHOLE)

_LABELS: Final = (  # from the skin outwards
    Label(0, "skin", BODY, (128, 128, 128), skin_contact=1.0),
    Label(2, "shoe", BODY, (128, 0, 255), skin_contact=0.3),
    Label(1, "hair", BODY, (255, 128, 0)),
    Label(4, "lower", "lower", (50, 180, 50)),
    Label(3, "upper", "upper", (180, 50, 50)),
    Label(5, "outer", "outer", (0, 128, 255)),
)
TOUCHING: Final = (  # (inner, outer): the outer layer must stay outside the inner one
    (BODY, "lower"),
    (BODY, "upper"),
    ("lower", "upper"),
    ("upper", "outer"),
    (BODY, "outer"),
    (BODY, CLOTHING),
)
ONE_PIECE: Final = ("lower", "upper")  # slots that a dress or a jumpsuit fills

LAYERS: Final = tuple(dict.fromkeys(label.layer for label in _LABELS))  # inner to outer: order of dressing
SLOTS: Final = tuple(layer for layer in LAYERS if layer != BODY)  # inner to outer

NO_LABEL: Final = 255
_BY_ID: Final = tuple(sorted(_LABELS))
LABEL_IDS: Final = tuple(label.id for label in _BY_ID)
LABELS: Final[dict[int, str]] = {label.id: label.name for label in _BY_ID} | {NO_LABEL: "none"}
LABEL_COLORS: Final[dict[int, tuple[int, int, int]]] = {label.id: label.color for label in _BY_ID} | {
    NO_LABEL: (255, 255, 255)
}
LAYER_OF_LABEL: Final[dict[int, str]] = {label.id: label.layer for label in _BY_ID}
SKIN_CONTACT: Final[dict[int, float]] = {label.id: label.skin_contact for label in _BY_ID}

SKIN: Final = 0
BODY_LABELS: Final = tuple(label.id for label in _LABELS if label.layer == BODY)  # inner to outer
GARMENT_LABELS: Final = tuple(label.id for label in _LABELS if label.layer != BODY)  # inner to outer
OUTERMOST_FIRST: Final = tuple(label.id for label in reversed(_LABELS))

# Regions of an image that are scored separately: each slot, and the body as "rest".
REGIONS: Final[dict[str, tuple[int, ...]]] = {
    **{label.layer: (label.id,) for label in _BY_ID if label.layer != BODY},
    "rest": BODY_LABELS,
}


def label_id(name: str) -> int:
    """Id of a label. Raises KeyError for an unknown name."""
    return {label.name: label.id for label in _LABELS}[name]


def label_of(layer: str) -> int:
    """Id that stands for a layer in label images: skin for the body. Raises KeyError for an unknown layer."""
    return {label.layer: label.id for label in reversed(_LABELS)}[layer]


def in_order(names: Iterable[str]) -> list[str]:
    """The layers among `names`, inner to outer."""
    present = set(names)
    return [layer for layer in LAYERS if layer in present]


def garments_of(names: Iterable[str]) -> list[str]:
    """All of `names` except the body, inner to outer; a baseline's clothing counts as a garment."""
    chosen = [name for name in names if name != BODY]
    return in_order(chosen) + [name for name in chosen if name not in LAYERS]


def label_legend() -> str:
    """Ids and names for messages: "0 skin, 1 hair, …"."""
    return ", ".join(f"{value} {name}" for value, name in LABELS.items())
