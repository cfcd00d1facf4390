"""How a layer goes on from what another subject taught it: which tensors are taken, which are made anew.

Attributes of texels and weights of networks are taken as they are. Anchors belong to the poses of a take:
those of the new take start with the offsets that the other subject's layer shows in the same poses.
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
from stages.train.cells import Cells
from stages.train.solve import Floats, fitted_cells


def is_frozen(model: Decoder) -> bool:
    """Whether a model has nothing to learn."""
    return not any(parameter.requires_grad for parameter in model.parameters())


def known_model(worn: WornLayer, device: torch.device) -> Decoder:
    """The model of a trained layer on a device, to be asked and never changed."""
    model = load_decoder(worn.model.config, worn.maps.to(device), worn.model.state()).to(device).eval()
    return model.requires_grad_(False)


def begun_model(worn: WornLayer, config: ModelConfig, device: torch.device) -> Decoder:
    """A decoder to be learned that begins as a trained layer; key poses and history are those of `config`.

    Raises:
        UsageProblem: the trained layer has key poses, and `config` has none.
    """
    return worn.model.warm_start(worn.maps.to(device), config).to(device)


def own_motion(model: Decoder, poses: Poses, frame: int, pose: FramePose) -> Tensor | None:
    """The recent motion as a model wants it: a layer learned elsewhere may remember longer or shorter."""
    history = model.model_config.history
    if pose.motion is not None and len(pose.motion) == motion_length(history):
        return pose.motion
    return recent_motion(poses, frame, history).to(pose.transforms)


class Beginnings:
    """The layers of a run that begin where another training ended; none of a usual run.

    Arguments:
        known: name to the model as it was. models: of the run. poses: of the take. pose: of a frame.

    Attributes:
        frozen: names of those that are not learned any more.
    """

    def __init__(
        self,
        known: Mapping[str, Decoder],
        models: Mapping[str, Decoder],
        poses: Poses,
        pose: Callable[[int], FramePose],
    ) -> None:
        self.known, self.models, self.poses, self.pose = known, models, poses, pose
        self.frozen = frozenset(name for name in known if is_frozen(models[name]))

    @torch.no_grad()
    def residuals(self, frame: int) -> dict[str, Tensor]:
        """(N, 14) of every such layer in a frame, without what its anchors add."""
        return {name: self._beside_anchors(name, frame) for name in self.known}

    @torch.no_grad()
    def offsets(self, frame: int) -> dict[str, Floats]:
        """(N, 3) m: what the anchors of such a layer have to add in a frame for the offsets that it had."""
        found = {}
        for name in self._anchored():
            model, known, pose = self.models[name], self.known[name], self.pose(frame)
            motion = own_motion(known, self.poses, frame, pose)
            wanted = known.residual(pose.local_transforms, motion=motion)[:, :3]
            metres = (wanted - self._beside_anchors(name, frame)[:, :3]) * model.model_config.offset_scale
            found[name] = np.asarray(metres.double().cpu().numpy())
        return found

    @torch.no_grad()
    def place_anchors(self, frames: list[int], tracked: bool) -> None:
        """Give anchors of the take to the layers that are learned on.

        They start with the offsets that the layers had, unless tracking is going to find them.
        """
        for name in self._anchored():
            model = self.models[name]
            poses = [self.pose(frame) for frame in frames]
            motions = [own_motion(model, self.poses, f, p) for f, p in zip(frames, poses, strict=True)]
            chosen = model.fit_key_poses(
                [pose.local_transforms for pose in poses], [m for m in motions if m is not None]
            )
            if not tracked:
                _fill_anchors(model, [self.offsets(frames[row])[name] for row in chosen.tolist()])

    def _anchored(self) -> list[str]:
        return [name for name in self.known if self.models[name].key_poses is not None]

    def _beside_anchors(self, name: str, frame: int) -> Tensor:
        model, pose = self.models[name], self.pose(frame)
        motion = own_motion(model, self.poses, frame, pose)
        return model.residual_without_key_poses(pose.local_transforms, motion)


def _fill_anchors(model: Decoder, offsets: list[Floats]) -> None:
    """Write the offsets (N, 3) m of frames into the key poses of a decoder, one after the other."""
    assert model.key_poses is not None
    anchors = model.key_poses.offsets
    cells = Cells.of(model.maps, model.key_poses.points, (anchors.shape[2], anchors.shape[3]))
    for row, values in enumerate(offsets):
        maps = torch.zeros(3, 2 * anchors.shape[2] * anchors.shape[3])
        maps[:, cells.where] = torch.from_numpy(fitted_cells(cells, values).T).float()
        sides = maps.view(3, 2, *anchors.shape[2:]).transpose(0, 1)
        anchors[row].copy_(sides.reshape(anchors.shape[1:]))
