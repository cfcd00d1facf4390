"""Configuration of `gw label`."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option


@dataclass(frozen=True)
class LabelConfig:
    """How the surface of the template is labelled. Declared fields have their help in their metadata.

    Attributes:
        strokes: corrections, as `strokes.read_strokes` gives them; they count as certain.
        rounds: how often colours are learned from the labels and labels are cut again.
        smallest_island_m2: patches of a label smaller than this take the label around them.
        smallest_share: a garment covering less of the template's area than this is not there.
    """

    strokes: tuple[Stroke, ...] = ()
    smoothness: float = option(2.0, "How much a border of labels costs.", min=0)
    rounds: int = 3
    smallest_island_m2: float = 0.002
    smallest_share: float = 0.005


@dataclass(frozen=True)
class Stroke:
    """A line that someone drew in a picture, or points on the surface, with the label that is there.

    Attributes:
        label: id of the label.
        points: pixels (x, y) of `view`, pixel centres at integer + 0.5; without a view (x, y, z) m world.
        radius: half of the line's width, in pixels of the view or in metres.
        view: name of the camera; None for points on the surface.
    """

    label: int
    points: tuple[tuple[float, ...], ...]
    radius: float
    view: str | None = None


PRESETS: dict[str, LabelConfig] = {name: LabelConfig() for name in ("tiny", "draft", "balanced", "paper")}
