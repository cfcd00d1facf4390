"""Settings of `gw export-garment`; light."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option


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
    """Of the template mesh of a layer. The help of each option is in its metadata.

    Attributes:
        layer: "body", "lower", "upper" or "outer".
    """

    layer: str = "lower"
    own_shape: bool = option(True, "With --mesh: in the subject's shape, or of zero shape.", panel="Mesh")
    texture: bool = option(
        True, "With --mesh: UVs and the layer's map as a texture, or colours of vertices.", panel="Mesh"
    )
    weights_per_vertex: int = option(
        8, "With --mesh: 8, or 4 for programs that read four weights.", panel="Mesh"
    )


PRESETS: dict[str, ExportGarmentConfig] = {
    name: ExportGarmentConfig() for name in ("tiny", "draft", "balanced", "paper")
}
