"""Splatting in plain torch: every pixel against every Gaussian, slow, and meant to be obviously right.

The oracle of the other backends. Computes in float64 whatever the input type, on any device, and is
differentiable by torch itself. One function is one step of the mathematics (Zwicker et al. 2001, EWA
splatting; Kerbl et al. 2023, 3D Gaussian splatting). Letters: N Gaussians, P pixels, C channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from stages.shared.quaternions import matrices_from_quaternions
from stages.shared.splat.gaussians import Rendering, stacked
from stages.shared.splat.scene import Scene, check_gaussians
from stages.shared.splat.settings import (
    ALPHA_MAX,
    ALPHA_MIN,
    FRUSTUM_MARGIN,
    TRANSMITTANCE_MIN,
    SplatSettings,
)

_PIXELS_AT_ONCE = 4096


@dataclass(frozen=True)
class Projected:
    """Gaussians in the image plane, in depth order (nearest first).

    index: (M,) row of each in the inputs. centers: (M, 2) px. conics: (M, 3) inverse covariance, entries
    xx, xy, yy, 1/px^2. depths: (M,) m. opacities: (M,).
    """

    index: Tensor
    centers: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Sigma = R S S R^T: (N, 4), (N, 3) m -> (N, 3, 3) m^2."""
    unit = quats / quats.norm(dim=-1, keepdim=True)
    axes = matrices_from_quaternions(unit) * scales[..., None, :]
    return axes @ axes.mT


def to_camera(means: Tensor, viewmat: Tensor) -> Tensor:
    """(N, 3) world, (4, 4) camera_from_world -> (N, 3) camera."""
    return means @ viewmat[:3, :3].T + viewmat[:3, 3]


def perspective(points: Tensor, intrinsics: Tensor) -> Tensor:
    """(N, 3) camera, (3, 3) -> (N, 2) px; the centre of the first pixel is (0.5, 0.5)."""
    focal = torch.stack([intrinsics[0, 0], intrinsics[1, 1]])
    return focal * points[:, :2] / points[:, 2:] + intrinsics[:2, 2]


def perspective_jacobian(points: Tensor, intrinsics: Tensor, width: int, height: int) -> Tensor:
    """d(px) / d(camera point): (N, 3) -> (N, 2, 3).

    The viewing direction is clamped to a slightly widened image: far outside it the linear approximation
    would smear a Gaussian over everything (Kerbl et al. 2023, section 4).
    """
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    with torch.no_grad():
        margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
        left, right = -cx / fx - margin_x, (width - cx) / fx + margin_x
        top, bottom = -cy / fy - margin_y, (height - cy) / fy + margin_y
    x, y, z = points.unbind(-1)
    u = (x / z).clamp(left, right)
    v = (y / z).clamp(top, bottom)
    zero = torch.zeros_like(z)
    rows = [fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z]
    return torch.stack(rows, -1).reshape(-1, 2, 3)


def image_covariances(covars: Tensor, viewmat: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sigma' = J W Sigma W^T J^T: (N, 3, 3) m^2 -> its entries xx, xy, yy, (N,) px^2 each.

    Rounded inputs can be indefinite by a hair; the off-diagonal entry is limited so that Sigma' is not.
    """
    m = jacobian @ viewmat[:3, :3]
    planar = m @ covars @ m.mT
    xx, xy, yy = planar[:, 0, 0].clamp_min(0), planar[:, 0, 1], planar[:, 1, 1].clamp_min(0)
    limit = (xx.sqrt() * yy.sqrt()).detach()  # their product can be too small for its type
    return xx, torch.where(xy.abs() > limit, limit * xy.sign().detach(), xy), yy


def project(
    means: Tensor,
    covars: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    settings: SplatSettings,
) -> Projected:
    """World Gaussians -> image plane, those in [near, far] only, sorted by depth.

    Depths are compared as float32 and equal ones keep the order of the input, in every backend.
    """
    points = to_camera(means, viewmat)
    with torch.no_grad():
        z = points[:, 2]
        inside = ((z > settings.near) & (z < settings.far)).nonzero()[:, 0]
        index = inside[torch.argsort(z[inside].to(torch.float32), stable=True)]
    points, covars, opacities = points[index], covars[index], opacities[index]
    jacobian = perspective_jacobian(points, intrinsics, width, height)
    xx, xy, yy = image_covariances(0.5 * (covars + covars.mT), viewmat, jacobian)
    sharp = (xx * yy - xy * xy).clamp_min(0)
    # det(Sigma' + eps I), written so that nothing cancels.
    blurred = sharp + (xx + yy + settings.eps2d) * settings.eps2d
    xx, yy = xx + settings.eps2d, yy + settings.eps2d
    if settings.antialiased:
        positive = sharp > 0
        ratio = torch.where(positive, sharp, 1.0) / blurred
        opacities = opacities * torch.where(positive, ratio.sqrt(), 0.0)
    conics = torch.stack([yy, -xy, xx], -1) / blurred[:, None]
    return Projected(index, perspective(points, intrinsics), conics, points[:, 2], opacities)


def alphas(gaussians: Projected, pixels: Tensor, least: float = ALPHA_MIN) -> Tensor:
    """Opacity times the falloff at every pixel, cut and clamped: pixel centres (P, 2) px -> (P, M)."""
    dx, dy = (pixels[:, None] - gaussians.centers[None]).unbind(-1)
    xx, xy, yy = gaussians.conics.unbind(-1)
    falloff = torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
    alpha = gaussians.opacities * falloff
    return torch.where(alpha >= least, alpha.clamp_max(ALPHA_MAX), 0.0)


def weights(alpha: Tensor, stop: float = TRANSMITTANCE_MIN) -> tuple[Tensor, Tensor]:
    """Front to back: alphas (P, M) -> w_k = alpha_k prod_{j<k} (1 - alpha_j) (P, M), T_end (P,)."""
    after = torch.cumprod(1 - alpha, 1)
    alpha = torch.where(after > stop, alpha, 0.0)
    transmittance = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(transmittance[:, :1]), transmittance[:, :-1]], 1)
    left = transmittance[:, -1] if transmittance.shape[1] else torch.ones_like(transmittance.sum(1))
    return alpha * before, left


def median_depths(w: Tensor, depths: Tensor) -> Tensor:
    """(P, M) weights, (M,) m -> (P,) m: depth where the accumulated alpha first reaches one half, or 0."""
    if w.shape[1] == 0:
        return w.sum(1)
    reached = (1 - w.cumsum(1)) <= 0.5
    first = reached.to(torch.int8).argmax(1)
    return torch.where(reached.any(1), depths[first], 0.0)


def render(
    gaussians: Projected,
    colors: Tensor,
    background: Tensor | None,
    width: int,
    height: int,
    members: Tensor | None = None,
    settings: SplatSettings = SplatSettings(),
) -> Rendering:
    """Composite M sorted Gaussians, colours (N, C) of all, into H x W pixels; `members` (M,) picks some."""
    features, opaque, depth, middle = [], [], [], []
    colors = colors[gaussians.index]
    like = gaussians.depths
    row, column = torch.meshgrid(
        torch.arange(height, device=like.device), torch.arange(width, device=like.device), indexing="ij"
    )
    centers = torch.stack([column.reshape(-1), row.reshape(-1)], -1).to(like.dtype) + 0.5
    for pixels in centers.split(_PIXELS_AT_ONCE):
        alpha = alphas(gaussians, pixels, settings.alpha_min)
        if members is not None:
            alpha = torch.where(members, alpha, 0.0)
        w, left = weights(alpha, settings.transmittance_min)
        features.append(w @ colors if background is None else w @ colors + left[:, None] * background)
        opaque.append(1 - left)
        depth.append(w @ gaussians.depths)
        if settings.median_depth:
            middle.append(median_depths(w.detach(), gaussians.depths.detach()))
    shape = (height, width)
    return Rendering(
        torch.cat(features).reshape(*shape, colors.shape[1]),
        torch.cat(opaque).reshape(shape),
        torch.cat(depth).reshape(shape),
        torch.cat(middle).reshape(shape) if settings.median_depth else None,
    )


def render_scene(scene: Scene) -> list[Rendering]:
    """The composite, then the layers alone: fields (B, H, W, ...), in the dtype of the means."""
    check_gaussians(scene)
    dtype, exact = scene.means.dtype, in_float64(scene)
    covars = exact.covars
    if exact.quats is not None and exact.scales is not None:
        covars = covariances(exact.quats, exact.scales)
    assert covars is not None
    shape, ids = (exact.width, exact.height), exact.layer_ids
    composite: list[Rendering] = []
    alone: list[list[Rendering]] = [[] for _ in exact.alone]
    for camera in range(len(exact.viewmats)):
        view, intrinsics = exact.viewmats[camera], exact.Ks[camera]
        gaussians = project(exact.means, covars, exact.opacities, view, intrinsics, *shape, exact.settings)
        background = None if exact.background is None else exact.background[camera]
        composite.append(render(gaussians, exact.colors, background, *shape, None, exact.settings))
        for layer, pictures in zip(exact.alone, alone, strict=True):
            assert ids is not None
            members, first = ids[gaussians.index] == layer, slice(exact.alone_channels)
            behind = None if background is None else background[first]
            pictures.append(
                render(gaussians, exact.colors[:, first], behind, *shape, members, exact.settings)
            )
    return stacked([composite, *alone], dtype)


def in_float64(scene: Scene) -> Scene:
    """The same scene with all numbers in float64; gradients pass."""
    names = ("means", "quats", "scales", "covars", "opacities", "colors", "viewmats", "Ks", "background")
    arrays = {name: getattr(scene, name) for name in names}
    return replace(scene, **{name: x.double() for name, x in arrays.items() if x is not None})
