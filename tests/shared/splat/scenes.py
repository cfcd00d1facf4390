"""Scenes for the splatting tests, and the comparison of a backend with the float64 reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from stages.shared.splat import reference
from stages.shared.splat.api import rasterize, rasterize_layers
from stages.shared.splat.gaussians import Rendering
from stages.shared.splat.settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, SplatSettings

FIELDS = ("features", "alpha", "depth")
PARAMETERS = ("means", "quats", "scales", "covars", "opacities", "colors", "viewmats", "Ks", "background")


@dataclass(frozen=True)
class Case:
    """Arguments of `rasterize` (or `rasterize_layers`, when there are layers)."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    covars: Tensor | None = None
    background: Tensor | None = None
    layer_ids: Tensor | None = None
    layers: int = 0
    alone: tuple[int, ...] | None = None
    alone_channels: int | None = None
    antialiased: bool = False
    alpha_min: float = ALPHA_MIN
    transmittance_min: float = TRANSMITTANCE_MIN
    precision: str = "single"

    def to(self, dtype: torch.dtype) -> Case:
        changed = {name: getattr(self, name) for name in PARAMETERS}
        return replace(self, **{k: None if v is None else v.to(dtype) for k, v in changed.items()})

    def parameters(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in PARAMETERS if getattr(self, name) is not None}

    def with_gradients(self) -> Case:
        leaves = {k: v.detach().clone().requires_grad_() for k, v in self.parameters().items()}
        return replace(self, **leaves)

    def render(self, backend: str, **options: Any) -> list[Rendering]:
        """The composite, then the layers alone."""
        arguments = (
            self.means, self.quats, self.scales, self.opacities, self.colors, self.viewmats, self.Ks,
            self.width, self.height,
        )  # fmt: skip
        names = ("antialiased", "alpha_min", "transmittance_min", "precision")
        settings = SplatSettings(**{name: getattr(self, name) for name in names} | options)
        options = {"covars": self.covars, "background": self.background, "backend": backend}
        options["settings"] = settings
        if not self.layers:
            return [rasterize(*arguments, **options)]
        assert self.layer_ids is not None
        chosen = {"alone": self.alone, "alone_channels": self.alone_channels}
        found = rasterize_layers(
            *arguments, layer_ids=self.layer_ids, layers=self.layers, **chosen, **options
        )
        return [replace(found, layers=()), *found.layers]


def look_at(distance: float = 3.0, turn: float = 0.3) -> Tensor:
    """(4, 4) camera_from_world of a camera that looks at the origin from `distance` metres."""
    c, s = math.cos(turn), math.sin(turn)
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = torch.tensor([[c, 0, s], [0, -1, 0], [s, 0, -c]], dtype=torch.float64)
    view[2, 3] = distance
    return view


def pinhole(width: int, height: int, focal: float) -> Tensor:
    """(3, 3), principal point a little off the middle."""
    k = torch.eye(3, dtype=torch.float64)
    k[0, 0], k[1, 1] = focal, focal * 1.1
    k[0, 2], k[1, 2] = 0.48 * width, 0.53 * height
    return k


def random_case(
    seed: int,
    n: int = 120,
    channels: int = 3,
    width: int = 41,
    height: int = 35,
    cameras: int = 0,
    layers: int = 0,
) -> Case:
    """Gaussians of mixed size, shape and opacity, some outside the picture and behind the camera."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g)

    views = look_at()
    if cameras:
        views = torch.stack([look_at(2.5 + 0.5 * i, 0.4 * i) for i in range(cameras)])
    return Case(
        means=(uniform(n, 3) - 0.5) * torch.tensor([4.0, 4.0, 7.0]),
        quats=torch.randn(n, 4, generator=g),
        scales=torch.exp(math.log(0.01) + math.log(40.0) * uniform(n, 3)),
        opacities=uniform(n) ** 0.5 * 0.98,
        colors=uniform(n, channels),
        viewmats=views.float(),
        Ks=pinhole(width, height, 45.0).float(),
        width=width,
        height=height,
        background=uniform(channels),
        layer_ids=torch.randint(0, max(layers, 1), (n,), generator=g, dtype=torch.int32),
        layers=layers,
    )


def avatar_case(seed: int, n: int = 2500, size: int = 56) -> Case:
    """Flat Gaussians on the surface of two capsules, mostly opaque, a few pixels each."""
    g = torch.Generator().manual_seed(seed)
    angle, up = 2 * math.pi * torch.rand(n, generator=g), torch.rand(n, generator=g) * 1.7 - 0.85
    radius = torch.where(torch.rand(n, generator=g) < 0.7, 0.22, 0.26)
    normal = torch.stack([angle.cos(), torch.zeros(n), angle.sin()], 1)
    half = 0.25 * math.pi - 0.5 * angle
    quats = torch.stack([half.cos(), torch.zeros(n), half.sin(), torch.zeros(n)], 1)
    scales = 0.012 + 0.012 * torch.rand(n, 3, generator=g)
    scales[:, 2] = 0.003
    means = normal * radius[:, None]
    means[:, 1] = up
    means = means + 0.002 * torch.randn(n, 3, generator=g)
    return Case(
        means=means,
        quats=quats,
        scales=scales,
        opacities=0.4 + 0.59 * torch.rand(n, generator=g),
        colors=torch.rand(n, 3, generator=g),
        viewmats=look_at(2.4).float(),
        Ks=pinhole(size, size, 1.2 * size).float(),
        width=size,
        height=size,
        background=torch.rand(3, generator=g),
    )


def settled_pixels(case: Case, band: float = 1e-4) -> Tensor:
    """([B,] H, W) pixels where no decision is closer than `band` (relative) to its threshold.

    The decisions are: alpha against its minimum and maximum, transmittance against the stop. Within the band
    float32 and float64 may decide differently, and both are right.
    """
    case = case.to(torch.float64)
    covars = case.covars
    if case.quats is not None and case.scales is not None:
        covars = reference.covariances(case.quats, case.scales)
    assert covars is not None
    batched = case.viewmats.ndim == 3
    views = case.viewmats if batched else case.viewmats[None]
    column, row = torch.arange(case.width) + 0.5, torch.arange(case.height) + 0.5
    pixels = torch.stack(torch.meshgrid(row, column, indexing="ij"), -1).reshape(-1, 2).flip(1).double()
    found = []
    for view in views:
        settings = SplatSettings(antialiased=case.antialiased)
        g = reference.project(
            case.means, covars, case.opacities, view, case.Ks, case.width, case.height, settings
        )
        dx, dy = (pixels[:, None] - g.centers[None]).unbind(-1)
        xx, xy, yy = g.conics.unbind(-1)
        raw = g.opacities * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
        near = ((raw / case.alpha_min - 1).abs() < band) | ((raw / ALPHA_MAX - 1).abs() < band)
        rows = [torch.ones(len(g.index), dtype=torch.bool)]
        if case.layer_ids is not None:
            rows += [case.layer_ids[g.index] == layer for layer in range(case.layers)]
        settled = ~near.any(1)
        for members in rows:
            alpha = torch.where(members & (raw >= case.alpha_min), raw.clamp_max(ALPHA_MAX), 0.0)
            left = torch.cumprod(1 - alpha, 1)
            settled &= ~((left - case.transmittance_min).abs() < 10 * band * case.transmittance_min).any(1)
        found.append(settled.reshape(case.height, case.width))
    return torch.stack(found) if batched else found[0]


def compare(case: Case, backend: str = "cpu", forward: float = 1e-5, gradient: float = 1e-4) -> None:
    """The backend against the float64 reference, on settled pixels: pictures, then all gradients.

    Pictures: largest absolute difference (depths: relative to the largest). Gradients: relative, in the norm
    of each array, and each entry relative to the array's largest.
    """
    settled = settled_pixels(case)
    assert settled.float().mean() > 0.9
    outcomes = []
    own = torch.float64 if case.precision == "double" else torch.float32
    for name, dtype in (("reference", torch.float64), (backend, own)):
        leaves = case.to(dtype).with_gradients()
        pictures = leaves.render(name)
        g = torch.Generator().manual_seed(7)
        loss = torch.zeros((), dtype=dtype)
        for picture in pictures:
            for field in FIELDS:
                values = getattr(picture, field)
                weight = torch.randn(values.shape, generator=g).to(dtype)
                keep = settled[..., None] if field == "features" else settled
                loss = loss + (values * weight * keep).sum()
        parameters = leaves.parameters()
        grads = torch.autograd.grad(loss, list(parameters.values()))
        outcomes.append((pictures, dict(zip(parameters, grads, strict=True))))
    (wanted, wanted_grads), (got, got_grads) = outcomes
    for index, (a, b) in enumerate(zip(wanted, got, strict=True)):
        for field in FIELDS:
            x, y = getattr(a, field).detach(), getattr(b, field).detach()
            if x.numel() == 0:
                continue
            error = (x - y).abs()[settled].max() / max(1.0, float(x.abs().max()))
            assert error <= forward, f"picture {index}, {field}: {error:.2e}"
    for name, x in wanted_grads.items():
        y = got_grads[name].double()
        assert torch.isfinite(y).all(), name
        if x.numel() == 0:
            continue
        relative = (x - y).norm() / x.norm().clamp_min(1e-12)
        assert relative <= gradient, f"gradient of {name}: {relative:.2e}"
        single = (x - y).abs().max() / x.abs().max().clamp_min(1e-12)
        assert single <= gradient, f"one gradient of {name}: {single:.2e}"
