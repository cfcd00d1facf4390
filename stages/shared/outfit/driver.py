"""What moves the texels of a garment in each frame of a motion.

A driver answers two questions about its layer:

- the attribute residual: which correction the decoder's base attributes get. `None` lets the decoder answer
  in every pose; a constant replaces that answer in all poses;
- the texel matrices: posed_from_canonical of every texel, from which centres and covariances follow
  (`deform.pose_layer`). `None` means linear blend skinning with the bones of the pose.

`simulated` cuts a garment for its wearer, as its shape-free Gaussians are; `own-size` keeps the size of the
person it was learned from. `bones` and `learned` have no state. A driver with a state over time (simulated
cloth) is told the motion in `prepare` and may compute ahead there. After that it is asked for single rows, in
any order, and by several threads at a time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from numpy.typing import NDArray
from torch import Tensor

from stages.shared.body import BodyModel, Poses
from stages.shared.errors import UsageProblem
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.simulation import OutfitSimulation, SimulatedDriver

DRIVES = ("auto", "bones", "learned", "simulated", "own-size")


class GarmentDriver(Protocol):
    """Moves the texels of one layer."""

    @property
    def kind(self) -> str:
        """Of `DRIVES`, for results and messages."""

    @property
    def residual(self) -> Tensor | None:
        """(N, 14) channels as in `TexelAttributes`, used in all poses; None: the decoder's own, per pose."""

    def prepare(self, poses: Poses, rows: Sequence[int]) -> None:
        """Called from one thread before `rows` of `poses`, in ascending order, are asked for."""

    def matrices(self, poses: Poses, row: int) -> Tensor | None:
        """(N, 3, 4) f32 posed_from_canonical of every texel, canonical (with the wearer's shape) to world.

        The linear part carries the covariance and need not be a rotation. None: linear blend skinning.
        """


@dataclass(frozen=True, eq=False)
class SkinnedDriver:
    """Linear blend skinning. kind: "learned" with the decoder's residual, "bones" with its constant part."""

    kind: str
    residual: Tensor | None = None

    def prepare(self, poses: Poses, rows: Sequence[int]) -> None:
        """Nothing: every pose stands alone."""

    def matrices(self, poses: Poses, row: int) -> Tensor | None:
        """None: the bones of the pose."""
        return None


LEARNED = SkinnedDriver("learned")


def bones_driver(layer: WornLayer) -> SkinnedDriver:
    """Skinning alone: all poses have the attributes of the decoder's mean over the training poses."""
    return SkinnedDriver("bones", layer.model.mean_residual_of_training().detach())


def choose_drivers(
    layers: Sequence[WornLayer], drive: str, body_model: BodyModel, betas: NDArray
) -> dict[str, GarmentDriver]:
    """A driver for every garment among `layers`; the body is always posed by its decoder.

    Arguments:
        layers: inner to outer. body_model, betas: the wearer, on whose body garments are simulated.
        drive: one of `DRIVES` for all garments, or LAYER=DRIVE pairs, as "lower=bones,upper=learned"; layers
            that are not named are driven as "auto", which is the layer's own default.

    Raises:
        UsageProblem: an unknown drive, a layer that is not worn, a simulation that the bundle does not have.
    """
    garments = {layer.name: layer for layer in layers if layer.slots}
    drives = _parse_drive(drive, garments)
    kinds = {
        name: layer.drive if drives[name] == "auto" else drives[name] for name, layer in garments.items()
    }
    patterns = {}
    for name, layer in garments.items():
        if kinds[name] in ("simulated", "own-size"):
            if layer.cloth is None:
                raise UsageProblem(
                    f"The garment {name!r} has no simulation mesh.",
                    "option --drive",
                    "Run gw fit-cloth and export the garment again, or use --drive learned or bones.",
                )
            own_size = kinds[name] == "own-size"
            patterns[name] = layer.cloth if own_size else layer.cloth.graded(body_model, betas)
    simulation = OutfitSimulation(body_model, betas, patterns) if patterns else None
    drivers: dict[str, GarmentDriver] = {}
    for name, layer in garments.items():
        if name in patterns and simulation is not None:
            drivers[name] = SimulatedDriver(layer, simulation, betas)
        else:
            drivers[name] = bones_driver(layer) if kinds[name] == "bones" else LEARNED
    return drivers


def _parse_drive(text: str, garments: Mapping[str, WornLayer]) -> dict[str, str]:
    """Layer name to drive."""
    if "=" in text:
        pairs = [tuple(word.strip() for word in part.split("=", 1)) for part in text.split(",")]
        drives = {**dict.fromkeys(garments, "auto"), **{pair[0]: pair[-1] for pair in pairs}}
    else:
        drives = dict.fromkeys(garments, text)
    for name, kind in drives.items():
        if name not in garments:
            raise UsageProblem(
                f"There is no garment {name!r}.",
                "option --drive",
                "Choose of: " + (", ".join(garments) or "none is worn") + ".",
            )
        if kind not in DRIVES:
            raise UsageProblem(
                f"There is no drive {kind!r}.", "option --drive", "Choose of: " + ", ".join(DRIVES) + "."
            )
    return drives
