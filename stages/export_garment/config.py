"""Settings of `gw export-garment`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExportGarmentConfig:
    """What goes into the bundle.

    Attributes:
        layer: "body", "lower", "upper" or "outer".
        slots: layers the garment takes up; () for what segment-layers found: a dress ("lower", "upper").
        distilled: take the blendshapes of `gw distill` instead of the networks.
        note: a sentence for people who get the file.
        beneath: carry the form of the source's body beneath the garment, which other bodies take over.
        beneath_frames: training poses over which that form is averaged.
        precision: "float16" where it costs nothing that can be seen (positions always have 32 bits), or
            "float32" everywhere.
        preview_size: pixels, width and height of the picture inside.
    """

    layer: str = "lower"
    slots: tuple[str, ...] = ()
    distilled: bool = False
    note: str = ""
    beneath: bool = True
    beneath_frames: int = 8
    precision: str = "float16"
    preview_size: int = 256


@dataclass(frozen=True)
class TemplateMeshConfig:
    """Of the template mesh of a layer.

    Attributes:
        layer: "body", "lower", "upper" or "outer".
        own_shape: in the subject's shape; false: of zero shape, as garments are exchanged.
    """

    layer: str = "lower"
    own_shape: bool = True


PRESETS: dict[str, ExportGarmentConfig] = {
    name: ExportGarmentConfig() for name in ("tiny", "draft", "balanced", "paper")
}
