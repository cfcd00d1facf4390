"""What a garment is made of, and how finely its motion is computed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

from stages.shared.errors import BadData

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
        names = {field.name for field in fields(cls)}
        if not isinstance(values, dict) or set(values) != names:
            raise _bad(f"A cloth material has the values {', '.join(sorted(names))}.", where)
        for name, (least, most) in _RANGES.items():
            value = values[name]
            if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
                raise _bad(f"{name} is {value!r}; it lies between {least:g} and {most:g}.", where)
        if not isinstance(values["balanced"], bool):
            raise _bad(f"balanced is {values['balanced']!r}; it is true or false.", where)
        numbers = {name: float(values[name]) for name in _RANGES}
        return cls(balanced=values["balanced"], **numbers)


_RANGES = {
    "density": (1e-3, 10.0),
    "edge_stiffness": (1.0, 1e9),
    "bending": (0.0, 1.0),
    "bending_damping": (0.0, 10.0),
    "drag": (0.0, 1e3),
    "skin_friction": (0.0, 10.0),
    "cloth_friction": (0.0, 10.0),
    "repulsion": (0.0, 0.1),
    "rest_curvature": (-2.0, 2.0),
    "steps_per_second": (1.0, 1e5),
}

TIGHT = Material()
LIGHT_KNIT = Material(edge_stiffness=1000.0, balanced=True)
FLARED = Material(
    edge_stiffness=60.0, bending=5e-5, repulsion=0.012, rest_curvature=0.5, steps_per_second=1200.0
)


def _bad(what: str, where: str) -> BadData:
    return BadData(what, where, "Fit the cloth again with 'gw fit-cloth'.")
