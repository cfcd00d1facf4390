"""How a layer goes on from what another subject taught it: which tensors are taken, which are made anew.

Attributes of texels and weights of networks are taken as they are. Anchors belong to the poses of a take:
those of the new take start with the offsets that the other subject's layer shows in the same poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoder import AvatarModel, load_model
from stages.shared.avatar.model import LayerModel
from stages.shared.avatar.motion import motion_length, recent_motion
from stages.shared.avatar.pose import FramePose
from stages.shared.body import Poses
from stages.shared.errors import UsageProblem
from stages.shared.outfit.layer import WornLayer
from stages.train.cells import Cells
from stages.train.solve import Floats, fitted_cells

_OF_THE_TAKE = ("anchors.", "mean_residual", "fading", "motion_scale", "prior.")


def is_frozen(model: AvatarModel) -> bool:
    """Whether a model has nothing to learn."""
    return not any(parameter.requires_grad for parameter in model.parameters())


def known_model(worn: WornLayer, device: torch.device) -> AvatarModel:
    """The model of a trained layer on a device, to be asked and never changed."""
    model = load_model(worn.model.config, worn.maps.to(device), worn.model.state()).to(device).eval()
    return model.requires_grad_(False)


def begun_model(worn: WornLayer, config: ModelConfig, device: torch.device) -> AvatarModel:
    """A model to be learned that begins as a trained layer; anchors and history are those of `config`.

    Raises:
        UsageProblem: the trained layer has anchors, and `config` has none.
    """
    known = worn.model
    if not isinstance(known, LayerModel):
        return load_model(known.config, worn.maps.to(device), known.state()).to(device)
    if known.anchors is not None and not config.anchors:
        raise UsageProblem(
            f"The layer {worn.name} was learned with anchors, and this run has none.",
            "option --from-subject",
            "Train both subjects with the same preset and the same --without.",
        )
    shape = replace(
        known.model_config,
        anchors=config.anchors,
        anchor_cell=config.anchor_cell,
        anchor_widths=config.anchor_widths,
        history=config.history,
    )
    model = LayerModel(worn.maps.to(device), shape)
    taken = {name: t for name, t in known.state().items() if not name.startswith(_OF_THE_TAKE)}
    missing, _ = model.load_state_dict(taken, strict=False)
    assert all(name.startswith(_OF_THE_TAKE) for name in missing)
    return model.to(device)


def own_motion(model: AvatarModel, poses: Poses, frame: int, pose: FramePose) -> Tensor | None:
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
        known: Mapping[str, AvatarModel],
        models: Mapping[str, AvatarModel],
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
            assert isinstance(model, LayerModel)
            poses = [self.pose(frame) for frame in frames]
            motions = [own_motion(model, self.poses, f, p) for f, p in zip(frames, poses, strict=True)]
            chosen = model.fit_anchors(
                [pose.local_transforms for pose in poses], [m for m in motions if m is not None]
            )
            if not tracked:
                _fill_anchors(model, [self.offsets(frames[row])[name] for row in chosen.tolist()])

    def _anchored(self) -> list[str]:
        return [name for name in self.known if getattr(self.models[name], "anchors", None) is not None]

    def _beside_anchors(self, name: str, frame: int) -> Tensor:
        model, pose = self.models[name], self.pose(frame)
        if isinstance(model, LayerModel):
            return model.of_networks(pose.local_transforms)
        return model.residual(pose.local_transforms, motion=own_motion(model, self.poses, frame, pose))


def _fill_anchors(model: Any, offsets: list[Floats]) -> None:
    """Write the offsets (N, 3) m of frames into the anchors of a model, one after the other."""
    anchors = model.anchors.offsets
    cells = Cells.of(model.maps, model.sample_points, tuple(anchors.shape[2:]))
    for row, values in enumerate(offsets):
        maps = torch.zeros(3, 2 * anchors.shape[2] * anchors.shape[3])
        maps[:, cells.where] = torch.from_numpy(fitted_cells(cells, values).T).float()
        sides = maps.view(3, 2, *anchors.shape[2:]).transpose(0, 1)
        anchors[row].copy_(sides.reshape(anchors.shape[1:]))
