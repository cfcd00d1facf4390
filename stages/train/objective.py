"""The loss of one step: picture terms per camera, surface terms per layer, and where gradients are handed on.

Pictures are differentiated one after the other, up to the Gaussians. What comes before the Gaussians is
differentiated once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.deform import PosedGaussians
from stages.shared.avatar.maps import LayerMaps
from stages.shared.capture import Camera
from stages.shared.capture.camera import Box
from stages.shared.layers import BODY, TOUCHING
from stages.shared.losses.flow import dense_flow, flow_loss
from stages.shared.losses.perceptual import Perceptual, mask_box, square_crop
from stages.shared.losses.picture import l1, label_loss, silhouette_loss, ssim_loss
from stages.shared.losses.surface import (
    covered_skin_loss,
    hand_texels,
    offset_loss,
    opacity_loss,
    penetration_loss,
    seam_loss,
    smooth_loss,
)
from stages.shared.splat.api import render_gaussians
from stages.shared.splat.gaussians import Gaussians, Rendering
from stages.train.config import LossWeights
from stages.train.views import View

_NAMES = ("means", "covariances", "opacities", "features")


def render(
    gaussians: Gaussians, camera: Camera, body_alone: bool = False, backend: str = "auto"
) -> Rendering:
    """Colours, labels, alpha and depth in one pass; with `body_alone`, `layers` has the body's alpha."""
    alone = (BODY,) if body_alone else ()
    return render_gaussians(gaussians, camera, alone=alone, alone_channels=0, backend=backend)


@dataclass(frozen=True)
class PerceptualCrops:
    """The crops of a view that the perceptual terms compare.

    Attributes:
        perceptual: the metric. side: of its crops, px. face: box of the face in the view, or None.
    """

    perceptual: Perceptual
    side: int
    face: Box | None

    def terms(
        self, image: Tensor, truth: Tensor, view: View, background: Tensor, weights: LossWeights
    ) -> dict[str, Tensor]:
        """LPIPS of the subject and of the face: those with a weight and with pixels.

        The mask's edge is background here, because LPIPS would see a line around the subject.
        """
        valid = view.valid[..., None]
        image, truth = (picture * valid + background * (1.0 - valid) for picture in (image, truth))
        boxes = {"lpips": mask_box(view.inside), "face": self.face}
        return {
            name: self.perceptual.distance(
                square_crop(image, box, self.side, background), square_crop(truth, box, self.side, background)
            )
            for name, box in boxes.items()
            if box is not None and getattr(weights, name) > 0
        }


def picture_terms(
    composite: Gaussians,
    view: View,
    background: Tensor,
    weights: LossWeights,
    label_kind: str,
    crops: PerceptualCrops | None = None,
) -> dict[str, Tensor]:
    """Unweighted picture terms of one camera; only those with a weight.

    `background` (3,) lies behind render and truth alike; pixels on the mask's edge do not count.
    Without `crops` there is no LPIPS.
    """
    body_alone = weights.silhouette > 0 and BODY in composite.layers
    picture = render(composite, view.camera, body_alone)
    valid = view.valid[..., None]
    image = picture.color + (1.0 - picture.alpha)[..., None] * background
    inside = view.inside[..., None]
    truth = view.image * inside + background * (1.0 - inside)
    terms = {}
    if weights.flow > 0:
        flow, trusted = dense_flow(image, truth)
        matrix, intrinsics = (x.to(composite.means) for x in view.camera.tensors())
        depth = picture.expected_depth.detach()
        terms["flow"] = flow_loss(
            composite.means, matrix, intrinsics, depth, flow.to(image), trusted.to(image.device)
        )
    if crops is not None:
        terms |= crops.terms(image, truth, view, background, weights)
    image, truth = image * valid, truth * valid
    if weights.l1 > 0:
        terms["l1"] = l1(image, truth)
    if weights.ssim > 0:
        terms["ssim"] = ssim_loss(image, truth)
    if weights.label > 0:
        terms["label"] = label_loss(picture.labels, view.labels, view.known, label_kind)
    if picture.layers:
        terms["silhouette"] = silhouette_loss(picture.layers[0].alpha, view.silhouette)
    return terms


@dataclass(frozen=True)
class SurfaceTopology:
    """What the surface terms need of the layers, computed once per run.

    Attributes:
        maps: name to maps. covered: body texels that share a pixel with a garment. hands: body texels on
            hands, which count as bare skin.
    """

    maps: dict[str, LayerMaps]
    covered: Tensor
    hands: Tensor

    @classmethod
    def of(cls, maps: dict[str, LayerMaps]) -> SurfaceTopology:
        """From the maps of all layers."""
        nothing = torch.zeros(0, dtype=torch.bool)
        if BODY not in maps:
            return cls(maps, nothing, nothing)
        body = maps[BODY]
        covered = body.covered_by([layer for name, layer in maps.items() if name != BODY])
        return cls(maps, covered, hand_texels(body.skin_weights) & ~covered)


def surface_terms(
    posed: dict[str, PosedGaussians],
    surfaces: SurfaceTopology,
    weights: LossWeights,
    margin: float,
    every: int = 1,
    phase: int = 0,
) -> dict[str, Tensor]:
    """Unweighted surface terms, summed over layers (or pairs of layers); only those with a weight.

    `margin` (m), `every` and `phase` are those of `penetration_loss`.
    """
    terms: dict[str, Tensor] = {}
    maps = surfaces.maps
    if weights.offset > 0:
        terms["offset"] = _total(offset_loss(layer.offsets) for layer in posed.values())
    if weights.smooth > 0:
        terms["smooth"] = _total(
            smooth_loss(layer.offsets, maps[name].neighbours) for name, layer in posed.items()
        )
    if weights.seam > 0:
        terms["seam"] = _total(
            seam_loss(layer.offsets, layer.colors, maps[name].seams) for name, layer in posed.items()
        )
    pairs = [(inner, outer) for inner, outer in TOUCHING if inner in posed and outer in posed]
    if weights.penetration > 0 and pairs:
        terms["penetration"] = _total(
            penetration_loss(
                posed[outer].means, posed[inner].means, posed[inner].normals, margin, every=every, phase=phase
            )
            for inner, outer in pairs
        )
    if BODY in posed and weights.opacity > 0:
        terms["opacity"] = opacity_loss(posed[BODY].opacities)
    if BODY in posed and weights.covered_skin > 0:
        terms["covered_skin"] = covered_skin_loss(posed[BODY].colors, surfaces.covered, surfaces.hands)
    return terms


def weighted(terms: dict[str, Tensor], weights: LossWeights) -> Tensor:
    """Sum of the terms times their weights; 0 without a gradient where there are no terms."""
    return _total(getattr(weights, name) * value for name, value in terms.items())


def _total(values: Iterable[Tensor]) -> Tensor:
    summands = list(values)
    return torch.stack(summands).sum() if summands else torch.zeros(())


def detach(composite: Gaussians) -> Gaussians:
    """The same Gaussians as inputs of a new graph."""
    inputs = {name: getattr(composite, name).detach().requires_grad_() for name in _NAMES}
    return replace(composite, **inputs)


def upstream_gradients(
    composite: Gaussians, detached: Gaussians, observed: Tensor | None = None
) -> list[tuple[Tensor, Tensor | None]]:
    """The composite's tensors, each with the gradient that its detached copy accumulated, where there is one.

    Arguments:
        observed: (N,) 0..1, factor of every Gaussian's gradients; None for 1.
    """
    pairs: list[tuple[Tensor, Tensor | None]] = []
    for name in _NAMES:
        output, gradient = getattr(composite, name), getattr(detached, name).grad
        if not output.requires_grad or gradient is None:
            continue
        if observed is not None:
            gradient = gradient * _like_rows(observed, gradient)
        pairs.append((output, gradient))
    return pairs


def take_gradients(detached: Gaussians) -> Tensor:
    """The accumulated gradients as one row (M,), zeros where there are none; they are reset."""
    tensors = [getattr(detached, name) for name in _NAMES]
    gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in tensors]
    for tensor in tensors:
        tensor.grad = None
    return torch.cat([gradient.flatten() for gradient in gradients])


def give_gradients(detached: Gaussians, gradients: Tensor) -> None:
    """Put gradients (M,) back, in the order of `take_gradients`."""
    tensors = [getattr(detached, name) for name in _NAMES]
    for tensor, part in zip(tensors, gradients.split([t.numel() for t in tensors]), strict=True):
        tensor.grad = part.view_as(tensor)


def observed_of(decoders: Iterable[Decoder]) -> Tensor | None:
    """(N,) `Decoder.observed` of all layers in order; None where every texel is observed."""
    decoders = list(decoders)
    if all(decoder.all_observed for decoder in decoders):
        return None
    return torch.cat([decoder.observed for decoder in decoders])


def mask_gradients(composite: Gaussians, observed: Tensor | None) -> None:
    """Multiply gradients that will reach the composite by `observed` (N,); None changes nothing."""
    if observed is None:
        return
    for name in _NAMES:
        tensor = getattr(composite, name)
        if tensor.requires_grad:
            tensor.register_hook(lambda gradient: gradient * _like_rows(observed, gradient))


def _like_rows(factors: Tensor, rows: Tensor) -> Tensor:
    """Factors (N,) in a shape that multiplies rows (N, …)."""
    return factors.view(-1, *[1] * (rows.ndim - 1))
