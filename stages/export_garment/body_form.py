"""What a bundle says about the source's body: its form beneath a garment, its skin where clothes were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from stages.shared.avatar.deform import Attributes
from stages.shared.avatar.pose import pose_at
from stages.shared.body import BodyModel, Poses
from stages.shared.outfit.body_replacement import covered_texels, extrapolate_skin
from stages.shared.outfit.layer import WornLayer


@torch.no_grad()
def mean_attributes(body: WornLayer, body_model: BodyModel, poses: Poses, frames: int) -> Attributes:
    """Offsets, quaternions and colours of the body's texels, averaged over `frames` poses, evenly spread."""
    chosen = np.unique(np.linspace(0, len(poses) - 1, frames).astype(int))
    mean: Attributes | None = None
    for frame in chosen:
        found = body.model(pose_at(body_model, poses, int(frame)).local_transforms)
        if mean is None:
            mean = found
            continue
        turned = found.quaternions
        # q and −q are one rotation: add them up on one side.
        turned = torch.where((turned * mean.quaternions).sum(1, keepdim=True) < 0, -turned, turned)
        mean = replace(
            mean,
            offsets=mean.offsets + found.offsets,
            quaternions=mean.quaternions + turned,
            colors=mean.colors + found.colors,
        )
    assert mean is not None
    return replace(
        mean,
        offsets=mean.offsets / len(chosen),
        quaternions=torch.nn.functional.normalize(mean.quaternions, dim=1),
        colors=mean.colors / len(chosen),
    )


def form_beneath(garment: WornLayer, body: WornLayer, mean: Attributes) -> dict[str, np.ndarray]:
    """`swap/…` arrays: the source's body beneath the garment."""
    texels = covered_texels(body.maps, garment.maps)
    return {
        "swap/texels": body.maps.texels[texels].numpy().astype(np.int32),
        "swap/offsets": mean.offsets[texels].numpy(),
        "swap/quaternions": mean.quaternions[texels].numpy(),
    }


def covered_skin(body: WornLayer, garments: list[WornLayer], mean: Attributes) -> dict[str, np.ndarray]:
    """`skin/…` arrays: how much clothes covered each texel of the body, and what it is without them."""
    skin = extrapolate_skin(body.maps, [garment.maps for garment in garments], mean.offsets, mean.colors)
    if skin is None:
        return {}
    return {
        "skin/covered": skin.covered.numpy(),
        "skin/offsets": skin.offsets.numpy(),
        "skin/colors": skin.colors.numpy(),
    }
