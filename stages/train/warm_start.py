"""Warm start: layers that continue from another subject's training, the inner outfit of the same person.

Outer garments are learned over a known body. The body is frozen. The other layers that both subjects have
continue from the inner outfit, and all garments learn together (Gaussian Wardrobe: freeze F_b, finetune F_u,
F_ℓ, F_o). A layer comes with the maps that it was learned on, on whatever grid. Nothing is resampled, and the
body equals the other subject's to the bit. Both share the canonical space without shape.

Base attributes and network weights are taken over as they are. Key poses belong to a take. Those of the new
take start with the offsets that the pretrained layer has in the same poses.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE, TRAIN
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.artifacts.workspace import CURRENT_NAME
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.registry import load_decoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import FramePose, motion_length, recent_motion
from stages.shared.body import BodyModel, Poses, shaped_vertices
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import BODY, in_order
from stages.shared.outfit.coverage import same_grid
from stages.shared.outfit.layer import WornLayer, layer_of_training
from stages.shared.poses import load_poses
from stages.train.config import DEFAULT_METHOD, LossWeights, TrainConfig
from stages.train.methods import method_called
from stages.train.tracking.control_grid import ControlGrid, Floats, fit_control_points

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


def is_frozen(decoder: Decoder) -> bool:
    """Whether a decoder has nothing to learn."""
    return not any(parameter.requires_grad for parameter in decoder.parameters())


def pretrained_decoder(layer: WornLayer, device: torch.device) -> Decoder:
    """A frozen copy of a trained layer's decoder on a device."""
    decoder = load_decoder(layer.model.config, layer.maps.to(device), layer.model.state()).to(device).eval()
    return decoder.requires_grad_(False)


def warm_started(layer: WornLayer, config: ModelConfig, device: torch.device) -> Decoder:
    """A decoder to be learned that starts as a trained layer; key poses and history are those of `config`.

    Raises:
        UsageProblem: the trained layer has key poses, and `config` has none.
    """
    return layer.model.warm_start(layer.maps.to(device), config).to(device)


def motion_for(decoder: Decoder, poses: Poses, frame: int, pose: FramePose) -> Tensor | None:
    """Recent motion with as many features as a decoder has; a pretrained one may have another number."""
    history = decoder.model_config.history
    if pose.motion is not None and len(pose.motion) == motion_length(history):
        return pose.motion
    return recent_motion(poses, frame, history).to(pose.transforms)


class PretrainedLayers:
    """The layers of a run that start from another training; none in a usual run.

    Arguments:
        decoders: name to the decoder as it was. models: of the run. poses: of the take. pose: of a frame.

    Attributes:
        frozen: names of those that are not learned any more.
    """

    def __init__(
        self,
        decoders: Mapping[str, Decoder],
        models: Mapping[str, Decoder],
        poses: Poses,
        pose: Callable[[int], FramePose],
    ) -> None:
        self.decoders, self.models, self.poses, self.pose = decoders, models, poses, pose
        self.frozen = frozenset(name for name in decoders if is_frozen(models[name]))

    @torch.no_grad()
    def residuals(self, frame: int) -> dict[str, Tensor]:
        """(N, 14) of every such layer in a frame, without its key poses."""
        return {name: self._base_residual(name, frame) for name in self.decoders}

    @torch.no_grad()
    def offsets(self, frame: int) -> dict[str, Floats]:
        """(N, 3) m that key poses must add in a frame, so that a layer has the offsets that it had."""
        offsets = {}
        for name in self._with_key_poses():
            model, decoder, pose = self.models[name], self.decoders[name], self.pose(frame)
            motion = motion_for(decoder, self.poses, frame, pose)
            target = decoder.residual(pose.local_transforms, motion=motion)[:, :3]
            metres = (target - self._base_residual(name, frame)[:, :3]) * model.model_config.offset_scale
            offsets[name] = np.asarray(metres.double().cpu().numpy())
        return offsets

    @torch.no_grad()
    def place_key_poses(self, frames: list[int], tracked: bool) -> None:
        """Give key poses of the take to the layers that are learned further.

        They start with the offsets that the layers had, unless tracking is going to fit them.
        """
        for name in self._with_key_poses():
            model = self.models[name]
            poses = [self.pose(frame) for frame in frames]
            motions = [motion_for(model, self.poses, f, p) for f, p in zip(frames, poses, strict=True)]
            chosen = model.fit_key_poses(
                [pose.local_transforms for pose in poses], [m for m in motions if m is not None]
            )
            if not tracked:
                _fill_key_poses(model, [self.offsets(frames[row])[name] for row in chosen.tolist()])

    def _with_key_poses(self) -> list[str]:
        return [name for name in self.decoders if self.models[name].key_poses is not None]

    def _base_residual(self, name: str, frame: int) -> Tensor:
        model, pose = self.models[name], self.pose(frame)
        motion = motion_for(model, self.poses, frame, pose)
        return model.residual_without_key_poses(pose.local_transforms, motion)


def _fill_key_poses(decoder: Decoder, offsets: list[Floats]) -> None:
    """Write the offsets (N, 3) m of frames into the key poses of a decoder, in order."""
    assert decoder.key_poses is not None
    key_poses = decoder.key_poses.offsets
    grid = ControlGrid.of(decoder.maps, decoder.key_poses.points, (key_poses.shape[2], key_poses.shape[3]))
    for row, values in enumerate(offsets):
        maps = torch.zeros(3, 2 * key_poses.shape[2] * key_poses.shape[3])
        maps[:, grid.where] = torch.from_numpy(fit_control_points(grid, values).T).float()
        sides = maps.view(3, 2, *key_poses.shape[2:]).transpose(0, 1)
        key_poses[row].copy_(sides.reshape(key_poses.shape[1:]))
