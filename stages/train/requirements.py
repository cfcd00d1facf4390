"""What the scene of a run requires, and what is left out and why: for `gw train --dry-run` and manifests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from stages.shared.avatar.decoders.cost import costs, joints_used, multiply_adds
from stages.shared.avatar.decoders.registry import decoder_class
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import pose_at
from stages.shared.avatar.used_joints import GROUPS, describe_rest
from stages.shared.body import BodyModel, Poses
from stages.shared.layers import LAYERS
from stages.train.config import TrainConfig
from stages.train.trainer import Trainer

_MOST_POSES = 400  # rows of a take that are looked at for joints at rest


def scene_requirements(
    maps: Mapping[str, LayerMaps], body: BodyModel, poses: Poses, frames: list[int], config: TrainConfig
) -> dict[str, dict[str, Any]]:
    """{"requires": {layer: its costs}, "left_out": {what: why}}; plain JSON.

    Arguments:
        maps: of the layers that are learned. poses: row = frame. frames: that are learned from.
        config: resolved (`resolve`).
    """
    rest = joints_that_rest(body, poses, frames)
    model = config.model
    anchors = min(model.anchors, len(frames)) if not config.track.frame_step else len(frames)
    shape = replace(model, anchors=anchors if model.anchors else 0)
    requires = {
        name: {
            "texels": len(layer),
            "sheets": layer.views,
            "share_of_the_grid": round(layer.window[2] * layer.window[3] / layer.grid_size**2, 3),
            "joints": joints_used(layer, tuple(rest)),
            "multiply_adds_per_frame": multiply_adds(layer, shape, anchors, tuple(rest)),
        }
        for name, layer in maps.items()
    }
    return {"requires": requires, "left_out": _left_out(maps, rest, config)}


def what_it_took(trainer: Trainer) -> dict[str, dict[str, Any]]:
    """{"costs": {layer: …}, "left_out": {what: why}} of a run, for its manifest."""
    rest = joints_that_rest(trainer.views.body, trainer.views.poses, trainer.frames)
    maps = {name: model.maps for name, model in trainer.models.items()}
    spent = {name: costs(model, tuple(rest)) for name, model in trainer.models.items()}
    return {"costs": spent, "left_out": _left_out(maps, rest, trainer.config)}


def joints_that_rest(body: BodyModel, poses: Poses, frames: list[int]) -> dict[str, str]:
    """Groups of joints that no frame moves, and what carries each (`used_joints.GROUPS`)."""
    rows = frames[:: max(1, len(frames) // _MOST_POSES)]
    return describe_rest(pose_at(body, poses, rows).local_transforms)


def _left_out(maps: Mapping[str, LayerMaps], rest: dict[str, str], config: TrainConfig) -> dict[str, str]:
    model, found = config.model, {}
    own = all(name in LAYERS for name in maps)
    for name in LAYERS if own else ():
        if name not in maps:
            found[f"layer {name}"] = "the labels do not show it: no maps, no network, no loss, no Gaussians"
    for name, layer in maps.items():
        if layer.views <= 2:
            found[f"further sheets of {name}"] = "views from front and back leave at most 1 % of it unseen"
        found |= decoder_class(model.decoder).omitted(layer, model)
        idle = [group for group in GROUPS if group not in rest and not _follows(layer, group)]
        if idle:
            found[f"joints of {name}: {', '.join(idle)}"] = "no texel follows them"
    for group, carrier in rest.items():
        found[f"joints: {group}"] = f"at rest in every frame; carried by the {carrier.replace('_', ' ')}"
    if not model.view_conditioning:
        found["view dependence"] = "colours of this preset do not depend on the viewing direction"
    if not model.history:
        found["recent motion"] = "--history 0"
    if not model.pose_prior:
        found["projection of unlike poses"] = "the preset has none"
    if not config.perceptual_digest:
        found["LPIPS terms"] = "no --perceptual-weights"
    if not config.track.frame_step or not model.anchors:
        found["tracking"] = "no frames are followed (--track-step 0, or nothing that could be)"
    return found


def _follows(layer: LayerMaps, group: str) -> bool:
    """Whether a texel has weight on a joint of a group."""
    return bool((layer.skin_weights[:, list(GROUPS[group].members)] > 0).any())
