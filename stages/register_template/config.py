"""Configuration of `gw register-template`."""

from __future__ import annotations

from dataclasses import dataclass, field

from stages.shared.option import PICTURE_SCALE, option

TEMPLATES = ("auto", "scan", "hull", "body")
POSES = ("given", "fit", "refine")
FULL_FIT = 120


@dataclass(frozen=True)
class RegisterTemplateConfig:
    """Which frame and which surface become the template, and how the surface is made.

    Attributes:
        template: "scan" (the capture's own mesh), "hull" (from the masks), "body" (the bare body model), or
            "auto": the scan where there is one, else the hull.
        frame: frame number; None is the scan's frame, or the one with arms and legs well apart.
        take: name of the training take; None is the first one with a scan, or the first.
        virtual_cameras: number of cameras rendered around the scans in place of the capture's own, or 0.
        bar: smallest share of the projected body that must lie inside the masks.
        hull_pitch_m: distance of the nodes at which the hull is carved, metres.
        hull_reach_m: how far from the body model the hull may go, metres.
        hull_rounded: whether the hull is cut down, between the views, to the thickness seen around the body.
        smoothing_steps: rounds of Taubin smoothing of a hull.
        edge_m: length of the edges of a hull after remeshing, metres.
        most_faces: scans with more faces are simplified.
        fit_steps: `FULL_FIT` gives every level of a fit all of its steps, a smaller number a share of them.
        poses: "given" (the capture's own, checked), "fit" (found from masks, and from the scan where that is
            the template), "refine" (the capture's own as the initial guess).
        hold_out: cameras that are not learned from but used to score novel views, in addition to the
            capture's own.
        picture_scale: size at which pictures and masks are looked at, 1 is the capture's; 0 for the size at
            which the distance of two nodes of the hull covers two to three pixels.
    """

    template: str = option("auto", "auto | scan | hull (of the masks) | body (bare).", choices=TEMPLATES)
    frame: int | None = option(None, "Frame of the template; chosen by its pose if left out.")
    take: str | None = option(None, "Training take of the template.")
    virtual_cameras: int = option(
        0, "Cameras rendered around the scans of every frame (4D-DRESS: 12).", min=0, max=64
    )
    bar: float = 0.90
    hull_pitch_m: float = 0.008
    hull_reach_m: float = 0.35
    hull_rounded: bool = True
    smoothing_steps: int = 8
    edge_m: float = 0.010
    most_faces: int = 200_000
    fit_steps: int = FULL_FIT
    poses: str = "given"
    hold_out: tuple[str, ...] = field(default=(), metadata={"omit_default": True})
    picture_scale: float = option(0.0, **PICTURE_SCALE)

    @property
    def effort(self) -> float:
        """Share of the steps of every level of a fit."""
        return self.fit_steps / FULL_FIT


PRESETS: dict[str, RegisterTemplateConfig] = {
    "tiny": RegisterTemplateConfig(hull_pitch_m=0.02, edge_m=0.025, fit_steps=40),
    "draft": RegisterTemplateConfig(),
    "balanced": RegisterTemplateConfig(hull_pitch_m=0.006, edge_m=0.008),
    "paper": RegisterTemplateConfig(hull_pitch_m=0.004, edge_m=0.006, fit_steps=200),
}
