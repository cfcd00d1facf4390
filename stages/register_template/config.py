"""Configuration of `gw register-template`."""

from __future__ import annotations

from dataclasses import dataclass

TEMPLATES = ("auto", "scan", "hull", "body")
POSES = ("given", "fit", "refine")
FULL_FIT = 120


@dataclass(frozen=True)
class RegisterTemplateConfig:
    """Which frame and which surface become the template, and how the surface is made.

    Attributes:
        template: "scan" (the capture's own mesh), "hull" (from the masks), "body" (the bare body model), or
            "auto": the scan where there is one, else the hull.
        take: name of the training take; None is the first one with a scan, or the first.
        frame: frame number; None is the scan's frame, or the one with arms and legs well apart.
        bar: least share of the projected body that must lie inside the masks.
        hull_pitch_m: distance of the nodes at which the hull is carved, metres.
        hull_reach_m: how far from the body model the hull may go, metres.
        hull_rounded: whether the hull is cut down to the thickness seen around the body, between the views.
        smoothing_steps: rounds of smoothing of a hull that shrink nothing.
        edge_m: length of the edges of a hull after remeshing, metres.
        most_faces: scans with more faces are simplified.
        fit_steps: `FULL_FIT` gives every level of a fit all of its steps, less a share of them.
        poses: "given" (the capture's own, checked), "fit" (found from masks, and from the scan where that is
            the template), "refine" (the capture's own as the start).
        virtual_cameras: how many cameras are rendered around the scans in place of the capture's own; 0 none.
        hold_out: cameras that are not learned from, for judging novel views, besides those the capture
            holds out.
    """

    template: str = "auto"
    take: str | None = None
    frame: int | None = None
    bar: float = 0.90
    hull_pitch_m: float = 0.008
    hull_reach_m: float = 0.35
    hull_rounded: bool = True
    smoothing_steps: int = 8
    edge_m: float = 0.010
    most_faces: int = 200_000
    fit_steps: int = FULL_FIT
    poses: str = "given"
    virtual_cameras: int = 0
    hold_out: tuple[str, ...] = ()

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
