"""Which texels of garments the training pictures show.

A shirt under a vest, the inside of a skirt or an armpit appear in no picture. What the pictures ask of the
Gaussians there is noise, so training leaves them out, and their colours are filled in afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.avatar.compose import compose
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.deform import PosedGaussians, pose_layer
from stages.shared.avatar.fabric_fill import continue_fabric, covering_discs
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import FramePose
from stages.shared.capture import Camera
from stages.shared.layers import BODY, LAYER_OF_LABEL, LAYERS
from stages.shared.splat.api import contributions

Item = TypeVar("Item")

# Pictures that must show a texel in full, or more of them in part; of few pictures a share.
LEAST_VIEWS, LEAST_SHARE = 2.0, 0.04
MOST_FRAMES, MOST_CAMERAS = 6, 16
_WIDENING = 2.0  # of discs: where a surface turns away from the maps, texels lie far apart
_OPAQUE = 0.99
_INSET_M = 0.02
_LEAST_FACING = 0.1  # cosine to the maps' axis
_PIXELS_PER_TEXEL = 2.0  # at this resolution the share of a texel can be told


def observed_texels(
    models: Mapping[str, Decoder],
    frames: Sequence[int],
    cameras: Callable[[int], Sequence[Camera]],
    pose: Callable[[int], FramePose],
    labels: Callable[[int, str], NDArray[np.uint8] | None] | None = None,
) -> dict[str, Tensor]:
    """(N,) bool per garment: texels that training pictures show, layers moved by the bones alone.

    The shares of a texel's area that the pictures show must add up to `LEAST_VIEWS` pictures, or to
    `LEAST_SHARE` of the pictures where that is less. Bones alone let a shirt stick out of its vest in some
    poses; a picture does not count where its labels show a layer further out.
    A texel whose neighbours decide otherwise by a majority is decided as they are, which removes speckles.

    Arguments:
        models: name to decoder, inner to outer. frames: of training. cameras: of training, of a frame.
        pose: of a frame. labels: label image (H, W) of a frame and a camera; None where there is none.
        At most `MOST_FRAMES` times `MOST_CAMERAS` pictures are drawn.
    """
    shares: dict[str, Tensor] = {
        name: model.base_opacity.new_zeros(len(model.maps)) for name, model in models.items()
    }
    areas = {name: _texel_areas(model.maps) for name, model in models.items()}
    pictures = 0
    with torch.no_grad():
        for frame in _some(frames, MOST_FRAMES):
            posed = {name: _on_bones(name, model, pose(frame)) for name, model in models.items()}
            for camera in _some(cameras(frame), MOST_CAMERAS):
                pictures += 1
                image = labels(frame, camera.name) if labels is not None else None
                for name, share in _shares(posed, areas, camera).items():
                    uncovered = share.clamp(max=1.0)
                    if image is not None:
                        uncovered = uncovered * ~_covered(posed[name].means, name, camera, image)
                    shares[name] += uncovered
    least = min(LEAST_VIEWS, LEAST_SHARE * pictures)
    return {
        name: _majority(share >= least, models[name].maps.neighbours)
        for name, share in shares.items()
        if name != BODY
    }


def fill_unobserved(model: Decoder) -> None:
    """Give the unobserved texels of a trained garment its fabric, as discs that leave no gaps."""
    observed = model.observed >= 1
    parameters = model.base_parameters()
    if not parameters or bool(observed.all()) or not bool(observed.any()):
        return
    with torch.no_grad():
        sigmoid = model.model_config.color == "sigmoid"
        color = parameters["color"]
        fabric = continue_fabric(
            model.maps, torch.sigmoid(color) if sigmoid else color, observed.cpu().numpy()
        )
        quaternions, scales, opacities = covering_discs(model.maps)
        values = {
            "color": torch.logit(fabric.clamp(0.02, 0.98)) if sigmoid else fabric,
            "quaternion": quaternions,
            "scale": scales.log(),
            "opacity": torch.logit(opacities),
        }
        for name, value in values.items():
            parameters[name][~observed] = value[~observed].to(parameters[name])


def _covered(means: Tensor, layer: str, camera: Camera, labels: NDArray[np.uint8]) -> Tensor:
    """(N,) bool: points whose pixel is labelled as a layer further out than their own."""
    outer = LAYERS[LAYERS.index(layer) + 1 :] if layer in LAYERS else ()
    over = np.zeros(256, bool)
    over[[label for label, name in LAYER_OF_LABEL.items() if name in outer]] = True
    pixels, _ = camera.project(means.cpu().numpy())
    inside = camera.in_view(pixels)
    column, row = np.where(inside[:, None], pixels, 0).astype(int).T
    return torch.from_numpy(inside & over[labels[row, column]]).to(means.device)


def _majority(chosen: Tensor, neighbours: Tensor) -> Tensor:
    """(N,) bool: `chosen`, or what more than half of the neighbours (N, 4; -1 for none) have."""
    present = neighbours >= 0
    votes = (chosen[neighbours.clamp(min=0)] & present).sum(dim=1)
    count = present.sum(dim=1)
    return torch.where(2 * votes > count, True, torch.where(2 * votes < count, False, chosen))


def _some(items: Sequence[Item], most: int) -> list[Item]:
    """At most `most` of the items, evenly spread."""
    rows = np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int))
    return [items[row] for row in rows]


def _on_bones(layer: str, model: Decoder, pose: FramePose) -> PosedGaussians:
    """The layer's surface without gaps: discs larger than those that are learned, nearly opaque.

    The body is made thinner: a fitted body and its large discs would cover clothes that lie close to it.
    """
    attributes = model.attributes(model.base_opacity.new_zeros(len(model.maps), 14))
    closed = replace(
        attributes,
        scales=attributes.scales * attributes.scales.new_tensor([_WIDENING, _WIDENING, 1.0]),
        opacities=torch.full_like(attributes.opacities, _OPAQUE),
    )
    posed = pose_layer(model.maps, closed, pose.transforms, pose.betas)
    return replace(posed, means=posed.means - _INSET_M * posed.normals) if layer == BODY else posed


def _texel_areas(maps: LayerMaps) -> Tensor:
    """(N,) m²: surface behind each texel, which grows where it turns away from front and back."""
    return maps.pitch**2 / maps.normals[:, 2].abs().clamp(min=_LEAST_FACING)


def _shares(
    posed: Mapping[str, PosedGaussians], areas: Mapping[str, Tensor], camera: Camera
) -> dict[str, Tensor]:
    """(N,) of every layer: the share of a texel's area (N,) m² that a picture shows."""
    composite = compose(dict(posed))
    depth = composite.means @ composite.means.new_tensor(camera.camera_from_world[2, :3])
    depth = (depth + float(camera.camera_from_world[2, 3])).clamp(min=1e-3)
    area = torch.cat([areas[name] for name in posed])
    texel = float(area.median().sqrt()) * float(camera.intrinsics[0, 0]) / float(depth.median())
    scale = min(1.0, _PIXELS_PER_TEXEL / max(texel, 1e-9))
    small = camera.scaled(scale) if scale < 1 else camera
    pixels = area * (float(small.intrinsics[0, 0]) / depth).square()
    counts = [len(layer.means) for layer in posed.values()]
    return dict(zip(posed, (contributions(composite, small) / pixels).split(counts), strict=True))
