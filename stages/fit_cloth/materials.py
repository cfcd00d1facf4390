"""The materials that are tried. A handful is enough: a long optimisation overfits the take."""

from __future__ import annotations

from dataclasses import replace

from stages.shared.cloth.material import FLARED, LIGHT_KNIT, TIGHT, Material
from stages.shared.errors import UsageProblem

CANDIDATES: dict[str, Material] = {
    "tight": TIGHT,
    "stiff": replace(TIGHT, bending=5e-5),
    "light_knit": LIGHT_KNIT,
    "flared": FLARED,
    "full_skirt": replace(FLARED, edge_stiffness=120.0, rest_curvature=1.0),
}


def candidates(names: tuple[str, ...]) -> dict[str, Material]:
    """Materials by name. Raises UsageProblem for a name that is not known."""
    for name in names:
        if name not in CANDIDATES:
            raise UsageProblem(
                f"There is no material {name!r}.",
                "option --materials",
                "Choose of: " + ", ".join(CANDIDATES) + ".",
            )
    return {name: CANDIDATES[name] for name in names}
