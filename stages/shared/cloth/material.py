"""What a garment is made of, and how finely its motion is computed."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from stages.shared.artifacts.bundle_cloth import MATERIAL_RANGES, check_material

STRAIN_LIMIT = 1.3  # no edge becomes longer than this times its rest length


@dataclass(frozen=True)
class Material:
    """Mechanical properties of cloth.

    Attributes:
        density: kilograms per square metre.
        edge_stiffness: spring constant of every edge, newton per metre.
        bending: bending stiffness, newton metre.
        bending_damping: time in which bending motion decays, seconds.
        drag: share of the velocity that still air takes, per second.
        skin_friction: Coulomb coefficient on the body.
        cloth_friction: Coulomb coefficient on other garments.
        repulsion: smallest distance between two vertices of the garment, metres; 0 is off.
        rest_curvature: share of the template's curvature that needs no force.
        balanced: whether rest lengths are chosen so that the template hangs in balance.
        steps_per_second: simulation steps in a second of motion.
    """

    density: float = 0.2
    edge_stiffness: float = 1e6
    bending: float = 1e-5
    bending_damping: float = 0.1
    drag: float = 3.5
    skin_friction: float = 0.08
    cloth_friction: float = 0.15
    repulsion: float = 0.0
    rest_curvature: float = 1.0
    balanced: bool = False
    steps_per_second: float = 1800.0

    def to_json(self) -> dict[str, float | bool]:
        """All values by name."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: object, where: str) -> Material:
        """Inverse of `to_json`.

        Raises:
            BadData: a value is missing, unknown, negative, not finite or far beyond any cloth.
        """
        check_material(values, where)
        assert isinstance(values, dict)
        numbers = {name: float(values[name]) for name in MATERIAL_RANGES}
        return cls(balanced=values["balanced"], **numbers)


TIGHT = Material(balanced=True)
LIGHT_KNIT = Material(edge_stiffness=1000.0, balanced=True)
FLARED = Material(
    edge_stiffness=60.0,
    bending=5e-5,
    repulsion=0.012,
    rest_curvature=0.5,
    balanced=True,
    steps_per_second=1200.0,
)
