"""Warm start: layers that continue from another subject's training, the inner outfit of the same person.

Outer garments are learned over a known body. The body is frozen. The other layers that both subjects have
continue from the inner outfit, and all garments learn together (Gaussian Wardrobe: freeze F_b, finetune F_u,
F_ℓ, F_o). A layer comes with the maps that it was learned on, on whatever grid. Nothing is resampled, and the
body equals the other subject's to the bit. Both share the canonical space without shape.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE, TRAIN
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.artifacts.workspace import CURRENT_NAME
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import BodyModel, shaped_vertices
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import BODY, in_order
from stages.shared.outfit.coverage import same_grid
from stages.shared.outfit.layer import WornLayer, layer_of_training
from stages.shared.poses import load_poses
from stages.train.config import DEFAULT_METHOD, LossWeights, TrainConfig
from stages.train.methods.registry import method_called

FROZEN = (BODY,)
INPUT_NAME = "from-subject"
_SAME_PERSON = 0.01  # m between two fits of one body, mean over the skin


@dataclass(frozen=True)
class WarmStart:
    """The layers that a run starts from; empty for a usual run.

    Attributes:
        layers: name to the layer as the other subject learned it, inner to outer.
        files: files that were read of the other subject. warnings: sentences for people.
    """

    layers: dict[str, WornLayer] = field(default_factory=dict)
    files: ExternalFiles | None = None
    warnings: tuple[str, ...] = ()

    @property
    def frozen(self) -> tuple[str, ...]:
        """Names of the layers that are not learned further."""
        return tuple(name for name in self.layers if name in FROZEN)

    @property
    def grids(self) -> dict[str, dict[str, Any]]:
        """The grid of every layer's maps, as bake-maps writes it."""
        return {
            name: {
                "pitch": layer.maps.pitch,
                "centre": list(layer.maps.centre),
                "grid_size": layer.maps.grid_size,
            }
            for name, layer in self.layers.items()
        }

    def weights(self, weights: LossWeights) -> LossWeights:
        """The weights without terms that only the body could reduce, where it is frozen."""
        if not self.frozen:
            return weights
        return replace(weights, silhouette=0.0, opacity=0.0, covered_skin=0.0, face=0.0)


def read_warm_start(
    other: Path,
    subject: Workspace,
    registered: Artifact,
    maps: dict[str, LayerMaps],
    config: TrainConfig,
) -> WarmStart:
    """The layers of `config.from_layers` (all that both have where it is empty) of a trained subject.

    Arguments:
        other: folder of the other subject. subject: to be trained.
        registered: its register-template artifact.
        maps: its baked layers.

    Raises:
        MissingInput: the other subject is not trained, or one of both has no such layer.
        UsageProblem: another body model, a baseline, the subject itself, nothing left to learn.
    """
    if other.resolve() == subject.root.resolve():
        raise _unusable("A subject cannot start from itself.", other, "Name the subject of the inner outfit.")
    if not method_called(config.method).baked_layers:
        raise UsageProblem(
            f"The baseline {config.method} does not start from layers.",
            "options --method and --from-subject",
            "Leave one of them out.",
        )
    theirs = Workspace(other)
    described, baked, trained = (theirs.require(spec) for spec in (REGISTER_TEMPLATE, BAKE_MAPS, TRAIN))
    if trained.manifest.inputs["bake-maps"].key != baked.key:
        raise MissingInput(
            "That subject's maps were made again after its training.", str(other), f"Run: gw train {other}"
        )
    body, their_body = (BodyModel.from_arrays(a.arrays("body.safetensors")) for a in (registered, described))
    if body.digest != their_body.digest:
        raise _unusable(
            "That subject was registered with another body model.",
            other,
            "Register both with the same one: gw register-template --body-model.",
        )
    model = trained.json("model.json")
    if not method_called(model.get("method", DEFAULT_METHOD)).baked_layers:
        raise _unusable(
            f"That subject was trained as the baseline {model['method']}.", other, f"Run: gw train {other}"
        )
    names = _chosen(config.from_layers, model["layers"], maps, other)
    layers = {name: layer_of_training(name, baked, trained) for name in names}
    ours, their_shape = (
        load_poses(a.file("smpl_params.npz"), b).betas for a, b in ((registered, body), (described, body))
    )
    warnings = [*_grid_warnings(layers, maps), *_shape_warnings(body, ours, their_shape)]
    return WarmStart(layers, _files(theirs, baked, trained, names), tuple(warnings))


def _chosen(
    wanted: tuple[str, ...], theirs: Collection[str], ours: Collection[str], other: Path
) -> list[str]:
    """The layers to start from, inner to outer."""
    names = wanted or tuple({*(name for name in ours if name in theirs), *FROZEN})
    for name in names:
        if name not in theirs:
            raise MissingInput(
                f"That subject has no trained layer {name!r}.",
                str(other),
                "It has: " + ", ".join(theirs) + ".",
            )
        if name not in ours:
            raise MissingInput(
                f"This subject has no layer {name!r} to start.",
                "option --from-layers",
                "Choose of: " + ", ".join(ours) + ".",
            )
    if all(name in FROZEN and name in names for name in ours):
        raise MissingInput(
            "Nothing is left to learn: this subject has no garment.",
            "layers of bake-maps",
            "Leave --from-subject out, or see what gw segment-layers found.",
        )
    return in_order(names)


def _files(theirs: Workspace, baked: Artifact, trained: Artifact, names: list[str]) -> ExternalFiles:
    """What was read, and the record that says which training is in use: another one there is noticed."""
    root = theirs.root.resolve()
    files = [root / TRAIN.name / CURRENT_NAME, trained.path.resolve() / "model.json"]
    for name in names:
        own = f"maps-{name}.safetensors"
        files.append(trained.path.resolve() / f"{name}.safetensors")
        files.append(
            trained.path.resolve() / own if trained.has(own) else baked.path.resolve() / f"{name}.safetensors"
        )
    return ExternalFiles(INPUT_NAME, root, files)


def _grid_warnings(layers: dict[str, WornLayer], maps: dict[str, LayerMaps]) -> list[str]:
    different = [name for name, layer in layers.items() if not same_grid(layer.maps, maps[name])]
    if not different:
        return []
    pitch = 1000 * layers[different[0]].maps.pitch
    return [
        f"the maps of {', '.join(different)} stay on that subject's grid; try-on cannot tell what layers on "
        f"another grid cover. gw bake-maps --pitch {pitch:g} puts this subject on the same one"
    ]


def _shape_warnings(body: BodyModel, ours: np.ndarray, theirs: np.ndarray) -> list[str]:
    first, second = (shaped_vertices(body, torch.from_numpy(betas)) for betas in (ours, theirs))
    apart = float((first - second).norm(dim=1).mean())
    if apart <= _SAME_PERSON:
        return []
    return [f"the two bodies differ by {1000 * apart:.0f} mm on average: is it the same person?"]


def _unusable(what: str, other: Path, fix: str) -> UsageProblem:
    return UsageProblem(what, f"option --from-subject {other}", fix)
