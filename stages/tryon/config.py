"""Settings of `gw tryon`; light."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.outfit.film import FILM_SIZES, FilmConfig


@dataclass(frozen=True)
class TryonConfig(FilmConfig):
    """A film of an outfit of bundles.

    Attributes:
        camera: "static" or "orbit".
    """

    camera: str = "static"


PRESETS: dict[str, TryonConfig] = {
    name: TryonConfig(width=width, height=height) for name, (width, height) in FILM_SIZES.items()
}
