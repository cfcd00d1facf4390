"""What a garment is made of, what its tracked offsets correct, and which driver follows the take best.

Where the take has label images, they judge: the share of the garment's outline that is wrong. The distance
to the tracked offsets decides between materials whose outlines are equally good, and without label images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.fit_cloth.mesh import with_material
from stages.fit_cloth.outlines import Outlines
from stages.fit_cloth.tracked import TrackedGarment, bones_places, learned_places
from stages.shared.body import Poses
from stages.shared.cloth.material import Material
from stages.shared.cloth.pattern import ClothPattern
from stages.shared.cloth.riding import averaging, ridden
from stages.shared.errors import BadData
from stages.shared.meshes import components
from stages.shared.outfit.simulation import OutfitSimulation

Doubles = NDArray[np.float64]

RESIDUAL_SHARE = 0.5  # of the mean residual: all of it fits the take and overstates other motions
_LONGEST_CORRECTION = 0.05  # metres
_STANDARD_ERRORS = 2.0  # of a paired difference that counts


@dataclass(frozen=True)
class Agreement:
    """How far a driver is from the take, in parts left out.

    Attributes:
        tracked: metres from the tracked garment, mean over frames and texels.
        outline: share of the garment's outline that is wrong (1 − IoU); None without label images.
        samples: (K,) what is compared, by frame.
    """

    tracked: float
    outline: float | None
    samples: Doubles

    @property
    def score(self) -> float:
        """What is compared: smaller is better."""
        return self.tracked if self.outline is None else self.outline


@dataclass(frozen=True, eq=False)
class FittedGarment:
    """A garment's pattern and how far every driver is from the take.

    Attributes:
        material: name of the candidate. residual: whether half of the mean residual is in the pattern.
        drivers: driver to agreement. trials: the same of every material, without residual; None where the
            simulation failed.
        drive: the best driver. simulation: of the garment with the chosen material, and of those beneath.
    """

    pattern: ClothPattern
    material: str
    residual: bool
    drivers: dict[str, Agreement]
    trials: dict[str, Agreement | None]
    drive: str
    simulation: OutfitSimulation


@dataclass(frozen=True, eq=False)
class _Take:
    """What a garment is compared with."""

    tracked: TrackedGarment
    outlines: Outlines | None

    def agreement(self, places: Callable[[int], NDArray]) -> Agreement:
        """Of a garment whose texels are at places(frame) (N, 3) m, world."""
        count = len(self.tracked.poses)
        rows = range(min(1, count - 1), count)  # the first frame is nearly the template
        apart = np.array([self.tracked.distance(row, places(row)) for row in rows])
        if self.outlines is None:
            return Agreement(float(apart.mean()), None, apart)
        outlines = self.outlines
        wrong = np.array([outlines.disagreement(row, places(row)) for row in outlines.views])
        return Agreement(float(apart.mean()), float(wrong.mean()), wrong)


def fit_garment(
    tracked: TrackedGarment,
    outlines: Outlines | None,
    pattern: ClothPattern,
    beneath: OutfitSimulation | None,
    materials: dict[str, Material],
    pose: Poses,
    detail: float,
) -> FittedGarment:
    """Choose material, residual and driver.

    Arguments:
        pattern: with any material. beneath: simulation of the garments beneath through the take.
        pose: one row, the template's pose. detail: of the simulations.
    """
    name, take = tracked.layer.name, _Take(tracked, outlines)
    trials: dict[str, Agreement | None] = {}
    runs: dict[str, tuple[ClothPattern, OutfitSimulation, list[Doubles]]] = {}
    inner = {} if beneath is None else beneath.patterns
    for label, material in materials.items():
        candidate = with_material(pattern, material, tracked.body, pose, detail)
        try:
            simulation = OutfitSimulation(
                tracked.body, tracked.poses.betas, {**inner, name: candidate}, detail=detail,
                keep_steps=True, beneath=beneath,
            )  # fmt: skip
            motion = [
                simulation.positions(tracked.poses, row)[name].astype(np.float64)
                for row in range(len(tracked.poses))
            ]
        except BadData:  # left the range of numbers: not a material for this garment
            trials[label] = None
            continue
        places = [_places(candidate, vertices) for vertices in motion]
        trials[label] = _of(take, places)
        runs[label] = candidate, simulation, motion
    if not runs:
        raise BadData(
            f"No material keeps the simulation of '{name}' within the range of numbers.",
            name,
            "Look at its layer with gw inspect; without gw fit-cloth it is driven by what was learned.",
        )
    label, agreement = best_material({label: trial for label, trial in trials.items() if trial is not None})
    chosen, simulation, motion = runs[label]
    residual, corrected = _residual(tracked, chosen, motion)
    held_out = _of(take, corrected)
    use = held_out.score < agreement.score
    if use:
        offsets = chosen.texel_offsets.astype(np.float64)
        offsets[:, 2] += RESIDUAL_SHARE * residual
        chosen = replace(chosen, texel_offsets=offsets.astype(np.float32))
    drivers = {"bones": _of(take, bones_places(tracked)), "simulated": held_out if use else agreement}
    learned = learned_places(tracked)
    if learned is not None:
        drivers["learned"] = _of(take, learned)
    drive = default_driver(drivers, chosen.faces, len(chosen.vertices))
    return FittedGarment(chosen, label, use, drivers, trials, drive, simulation)


def _of(take: _Take, places: Sequence[NDArray]) -> Agreement:
    return take.agreement(lambda row: places[row])


def _places(pattern: ClothPattern, vertices: Doubles) -> NDArray[np.float32]:
    return ridden(pattern.riding, vertices, pattern.faces)[0].astype(np.float32)


def _residual(
    tracked: TrackedGarment, pattern: ClothPattern, motion: list[Doubles]
) -> tuple[Doubles, list[Doubles]]:
    """The mean residual (N,) m along the normals, smooth over the mesh; and places with half of it.

    The places (N, 3) of every frame are corrected with the mean of the other parts of the take. What lies
    along the surface is left out: the outline, which judges the correction, does not show it.
    """
    smooth = averaging(pattern.riding, pattern.faces, len(pattern.vertices))
    triangles, weights = pattern.faces[pattern.texel_faces], pattern.texel_weights.astype(np.float64)
    parts = np.unique(tracked.part_of)
    sums = np.zeros((len(parts), len(pattern.texel_faces)))
    for row, vertices in enumerate(motion):
        places, frames = ridden(pattern.riding, vertices, pattern.faces)
        normals = frames[:, :, 2]
        sums[tracked.part_of[row]] += np.einsum("nc,nc->n", normals, tracked.positions(row) - places)

    def mean(chosen: NDArray[np.bool_]) -> Doubles:
        count = max(int(np.isin(tracked.part_of, parts[chosen]).sum()), 1)
        at_vertices = smooth @ (sums[chosen].sum(axis=0) / count)
        spread = np.einsum("nk,nk->n", weights, at_vertices[triangles])
        return np.clip(spread, -_LONGEST_CORRECTION, _LONGEST_CORRECTION)

    nothing = np.zeros(len(pattern.texel_faces))
    others = {int(part): mean(parts != part) if len(parts) > 1 else nothing for part in parts}
    corrected = []
    for row, vertices in enumerate(motion):
        places, frames = ridden(pattern.riding, vertices, pattern.faces)
        correction = RESIDUAL_SHARE * others[int(tracked.part_of[row])]
        corrected.append(places + frames[:, :, 2] * correction[:, None])
    return mean(np.ones(len(parts), dtype=bool)), corrected


def best_material(trials: dict[str, Agreement]) -> tuple[str, Agreement]:
    """The material nearest to the tracked garment, of those whose outline is as good as the best.

    An outline hardly shows how far cloth slides along the body. Its print does, and tracking follows that.
    """
    best = min(trials.values(), key=lambda trial: trial.score)
    equal = {label: trial for label, trial in trials.items() if not is_worse(trial, best)}
    label = min(equal, key=lambda name: equal[name].tracked)
    return label, equal[label]


def is_worse(one: Agreement, other: Agreement) -> bool:
    """Whether the mean of the paired differences is more than twice its standard error above zero."""
    difference = one.samples - other.samples
    error = difference.std(ddof=1) / np.sqrt(len(difference)) if len(difference) > 1 else 0.0
    return bool(difference.mean() > _STANDARD_ERRORS * error)


def default_driver(drivers: dict[str, Agreement], faces: NDArray[np.int32], vertices: int) -> str:
    """The best driver; simulation unless another one is significantly better.

    Simulation is preferred because it does not know the take, and learned offsets do: in motions that are
    unlike the take they fall behind. A mesh in several pieces is never simulated by default, since nothing
    ties them together.
    """
    pieces = int(components(faces, vertices).max(initial=0)) + 1
    others = [driver for driver in drivers if driver != "simulated"]
    best = min(others, key=lambda driver: drivers[driver].score)
    if pieces > 1:
        return best
    return best if is_worse(drivers["simulated"], drivers[best]) else "simulated"
