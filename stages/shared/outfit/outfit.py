"""What is worn: slots, order, conflicts; and the whole outfit in a pose."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.artifacts.bundle import Bundle
from stages.shared.avatar.compose import compose, relabelled
from stages.shared.avatar.deform import PosedGaussians, Replacement, pose_layer
from stages.shared.avatar.pose import pose_at, recent_motion
from stages.shared.body import BodyModel, Poses
from stages.shared.errors import BadData, UsageProblem
from stages.shared.layers import BODY, LAYERS
from stages.shared.outfit.body_replacement import plan_swap, plan_uncovered_skin
from stages.shared.outfit.collision_correction import CollisionCorrection, plan_correction
from stages.shared.outfit.driver import LEARNED, GarmentDriver, choose_drivers
from stages.shared.outfit.layer import WornLayer, layer_of_bundle
from stages.shared.outfit.retarget import can_retarget, retarget_garment
from stages.shared.splat.gaussians import Gaussians

_MOMENTS = 64


@dataclass(frozen=True, eq=False)
class Outfit:
    """A dressed body.

    Attributes:
        body_model: bones and their weights on the shape.
        betas: (10,) f32 shape of the wearer, β*.
        layers: inner to outer, body first.
        swaps: replacements of the body's form under garments of other people, inner garments first.
        corrections: how garments of other people give way to the body.
        uncovered_skin: replacement of skin that clothes covered in training and that is bare now.
        drivers: of layers whose texels are not moved by their decoder and the bones.
    """

    body_model: BodyModel
    betas: NDArray[np.float32]
    layers: tuple[WornLayer, ...]
    swaps: tuple[Replacement, ...] = ()
    corrections: tuple[CollisionCorrection, ...] = ()
    uncovered_skin: Replacement | None = None
    drivers: Mapping[str, GarmentDriver] = field(default_factory=dict)

    def driven(self, drive: str, trained_poses: bool = False) -> Outfit:
        """The outfit with the drivers that `choose_drivers` names; they fit these layers and this shape.

        Arguments:
            trained_poses: the poses are those that the garments were learned in, where "auto" means learned.

        Raises:
            UsageProblem: as `choose_drivers`.
        """
        if trained_poses:
            learned = tuple(replace(layer, drive="learned") for layer in self.layers)
            return replace(self, layers=learned).driven(drive)
        return replace(self, drivers=choose_drivers(self.layers, drive, self.body_model, self.betas))

    def prepare(self, poses: Poses, rows: Sequence[int]) -> None:
        """Tell the drivers which rows of a motion will be posed, in ascending order."""
        for driver in self.drivers.values():
            driver.prepare(poses, rows)

    def driver(self, layer: WornLayer) -> GarmentDriver:
        """What moves a layer."""
        return self.drivers.get(layer.name, LEARNED)

    @property
    def replacements(self) -> tuple[Replacement, ...]:
        """What the outfit replaces of the body: first uncovered skin, then the form under garments."""
        skin = self.uncovered_skin
        return self.swaps if skin is None else (skin, *self.swaps)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the layers, inner to outer."""
        return tuple(layer.name for layer in self.layers)

    @property
    def gaussians(self) -> int:
        """Number of Gaussians of all layers."""
        return sum(len(layer.maps) for layer in self.layers)

    @torch.no_grad()
    def posed(self, poses: Poses, frame: int) -> dict[str, PosedGaussians]:
        """All layers in the pose of a row of `poses`, in the world. Its betas are not used."""
        pose = pose_at(self.body_model, poses, frame, self.betas)
        posed: dict[str, PosedGaussians] = {}
        # Simulated garments collide with the body themselves.
        corrections = {
            correction.garment: correction
            for correction in self.corrections
            if self.drivers.get(correction.garment, LEARNED).kind != "simulated"
        }
        for layer in self.layers:
            driver = self.driver(layer)
            residual = driver.residual
            if residual is None:
                history = layer.model.model_config.history
                motion = recent_motion(poses, frame, history) if history else None
                residual = layer.model.residual(pose.local_transforms, motion=motion)
            attributes = layer.model.attributes(residual)
            if layer.name == BODY:
                for replacement in self.replacements:
                    attributes = replacement.applied(attributes)
            matrices = driver.matrices(poses, frame)
            posed[layer.name] = pose_layer(layer.maps, attributes, pose.transforms, pose.betas, matrices)
            if layer.name in corrections:
                posed[layer.name] = corrections[layer.name].applied(posed[layer.name], posed[BODY])
        return posed

    @torch.no_grad()
    def projected_frames(self, poses: Poses, rows: Iterable[int]) -> dict[str, int]:
        """Rows of `poses` unlike the training's, counted by layer: there the networks see a projection."""
        counts: dict[str, int] = {}
        models = {
            layer.name: layer.model
            for layer in self.layers
            if layer.model.projects and self.driver(layer).residual is None
        }
        asked = list(rows) if models else []
        for first in range(0, len(asked), _MOMENTS):  # bones of many rows cost little more than those of one
            some = asked[first : first + _MOMENTS]
            moments = pose_at(self.body_model, poses, some, self.betas)
            for local in moments.local_transforms:
                for name, model in models.items():
                    counts[name] = counts.get(name, 0) + model.projected(local)
        return counts

    def composite(self, poses: Poses, frame: int) -> Gaussians:
        """All Gaussians together, in the pose of a row of `poses`; layers are those the labels know."""
        composite = compose(self.posed(poses, frame))
        if all(layer.layer_ids is None for layer in self.layers):
            return composite
        ids = [
            torch.full((len(layer.maps),), LAYERS.index(layer.name))
            if layer.layer_ids is None
            else layer.layer_ids
            for layer in self.layers
        ]
        return relabelled(composite, torch.cat(ids), LAYERS)


def outfit_of_bundles(
    named: Sequence[tuple[str, Bundle]],
    betas: NDArray[np.float32] | None = None,
    swap: bool = True,
    push: bool = False,
    restore: bool = True,
) -> Outfit:
    """Dress a body bundle in garment bundles.

    Arguments:
        named: (name for messages, bundle), in any order: the layers decide which lies over which.
        betas: (10,) shape of the wearer; the body bundle's own when None.
        swap: under garments, take the form of the body of the garment's source.
        push: let garments of other people give way to the body.
        restore: give skin that is bare now, and was covered when it was learned, the look of the skin around.

    Raises:
        UsageProblem: no body, two bodies, two garments for one slot. BadData: made for another body model.
    """
    body_name, body = _the_body(named)
    garments = [(name, bundle) for name, bundle in named if bundle.kind == "garment"]
    _check_slots(garments)
    ordered = sorted(garments, key=lambda item: LAYERS.index(item[1].layer))
    model = BodyModel.from_arrays(body.group("body"), body_name)
    wearer = layer_of_bundle(body, body_name)
    layers = (wearer, *(_fitting(name, bundle, body, wearer, model) for name, bundle in ordered))
    swaps = [plan_swap(layers[0], layer) for layer in layers[1:]] if swap else []
    corrections = [plan_correction(layers[0], layer) for layer in layers[1:]] if push else []
    shape = np.asarray(body.arrays["betas"] if betas is None else betas, dtype=np.float32)
    return Outfit(
        model,
        shape,
        layers,
        tuple(change for change in swaps if change is not None),
        tuple(found for found in corrections if found is not None),
        plan_uncovered_skin(layers[0], layers[1:]) if restore else None,
    )


def _fitting(name: str, garment: Bundle, body: Bundle, wearer: WornLayer, model: BodyModel) -> WornLayer:
    """A garment's layer, carried over to the wearer's body model where it was made with another one."""
    if garment.manifest["body_model"]["digest"] == body.manifest["body_model"]["digest"]:
        return layer_of_bundle(garment, name)
    if not can_retarget(garment):
        raise BadData(
            f"{name} was made with another body model than the body, and does not say where its bones were.",
            name,
            "Export it again with this version of gw, or train both with one body model "
            "(gw register-template --body-model).",
        )
    return retarget_garment(layer_of_bundle(garment, name), garment.arrays["joints"], wearer, model)


def _the_body(named: Sequence[tuple[str, Bundle]]) -> tuple[str, Bundle]:
    bodies = [(name, bundle) for name, bundle in named if bundle.kind == "body"]
    if not bodies:
        raise UsageProblem(
            "None of the bundles is a body.",
            ", ".join(name for name, _ in named) or "bundles",
            "Add one: gw export-garment SUBJECT --layer body -o body.gwg.",
        )
    if len(bodies) > 1:
        raise UsageProblem(
            f"There are {len(bodies)} bodies.", ", ".join(name for name, _ in bodies), "Leave one of them."
        )
    return bodies[0]


def _check_slots(garments: Sequence[tuple[str, Bundle]]) -> None:
    taken: dict[str, str] = {}
    for name, bundle in garments:
        for slot in bundle.manifest["slots"]:
            if slot in taken:
                raise UsageProblem(
                    f"{taken[slot]} and {name} are both worn as {slot}.",
                    f"{taken[slot]}, {name}",
                    "Leave one of them out.",
                )
            taken[slot] = name
