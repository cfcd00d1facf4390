"""The numbers of the splatting contract, the same for every backend."""

from __future__ import annotations

import math
from dataclasses import dataclass

from stages.shared.errors import UsageProblem

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian contributes to a pixel only where its alpha reaches this; below, it cannot change 8 bits."""

ALPHA_MAX = 0.999
"""Alpha is clamped here, so that 1 - alpha never vanishes and gradients stay finite."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel stops before the Gaussian that would take its transmittance to this or below."""

FRUSTUM_MARGIN = 0.3
"""The perspective Jacobian is taken inside the image widened by this share of half its width (height)."""


SHORTEST_QUATERNION = 1e-15
"""A quaternion without a larger entry is refused: its gradient grows with 1 / length and leaves float32."""


PRECISIONS = ("single", "double")


@dataclass(frozen=True)
class SplatSettings:
    """Options of one rendering, the same for `rasterize` and `rasterize_layers`.

    near, far: metres of camera depth outside which Gaussians are left out.
    eps2d: variance in px^2 added to both axes of every projected Gaussian (the 3DGS blur).
    antialiased: multiply opacity by sqrt(det before / det after the blur) (Mip-Splatting, eq. 9).
    alpha_min: a Gaussian counts where its alpha reaches this. Larger is faster and coarser.
    transmittance_min: a pixel stops before the Gaussian that would take its transmittance to this or below;
        0 never stops, and alpha may then round to 1.
    precision: of the pictures on a CPU: "single", or "double" (slow; for tests and fine comparisons).
    median_depth: also return the median depth.
    """

    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    antialiased: bool = False
    alpha_min: float = ALPHA_MIN
    transmittance_min: float = TRANSMITTANCE_MIN
    precision: str = "single"
    median_depth: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far or math.isnan(self.far):
            raise UsageProblem(
                f"Depths from {self.near} to {self.far} m are not possible.",
                "near, far",
                "Use 0 < near < far.",
            )
        if not 1e-6 <= self.eps2d <= 1e6:
            raise UsageProblem(f"A blur of {self.eps2d} px^2 is not possible.", "eps2d", "Use 1e-6 to 1e6.")
        if not (1e-6 <= self.alpha_min <= 0.5 and 0 <= self.transmittance_min <= 0.5):
            raise UsageProblem(
                f"Cut-offs of {self.alpha_min} and {self.transmittance_min} are not possible.",
                "alpha_min, transmittance_min",
                "Use 1e-6 to 0.5 for alpha, 0 to 0.5 for transmittance.",
            )
        if self.precision not in PRECISIONS:
            raise UsageProblem(
                f"There is no precision {self.precision!r}.",
                "precision",
                "Use " + " or ".join(PRECISIONS) + ".",
            )
