"""Settings of `gw render`; light."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.outfit.film import FILM_SIZES, FilmConfig


@dataclass(frozen=True)
class RenderConfig(FilmConfig):
    """A film of a subject or of bundles, and what else is written.

    Attributes:
        camera: "static", "orbit", the name of one camera of the capture, or a JSON file (camera_path.py).
        turns: how often "orbit" walks around; negative the other way.
        take: which take of the capture, "" for its only (test) take.
        distilled: of a subject, show the blendshapes of `gw distill` instead of the networks.
        layers: only these; () for all.
        video: "auto" (H.264, or VP9 where there is no encoder or the background is transparent), "h264",
            "vp9" or "none".
        exports: of "ply", "spz", "glb": the Gaussians of every frame.
        pictures: whether there are pictures, or exports only.
    """

    camera: str = ""
    turns: float = 1.0
    take: str = ""
    distilled: bool = False
    layers: tuple[str, ...] = ()
    video: str = "auto"
    exports: tuple[str, ...] = ()
    pictures: bool = True


PRESETS: dict[str, RenderConfig] = {
    name: RenderConfig(width=width, height=height) for name, (width, height) in FILM_SIZES.items()
}
