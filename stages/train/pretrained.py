"""Layers that continue from another subject's training: what is taken over, and what is fitted to the take.

Base attributes and network weights are taken over as they are. Key poses belong to a take. Those of the new
take start with the offsets that the pretrained layer has in the same poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.registry import load_decoder
from stages.shared.avatar.motion import motion_length, recent_motion
from stages.shared.avatar.pose import FramePose
from stages.shared.body import Poses
from stages.shared.outfit.layer import WornLayer
from stages.train.tracking.control_grid import ControlGrid, Floats, fit_control_points


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
