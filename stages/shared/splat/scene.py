"""The checked input of a backend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.shared.errors import BadData, UsageProblem
from stages.shared.splat.settings import SHORTEST_QUATERNION, SplatSettings

_LARGEST_SIDE = 1 << 16


@dataclass(frozen=True)
class Scene:
    """Gaussians and cameras, shapes checked.

    means (N, 3) m world; quats (N, 4) wxyz and scales (N, 3) m, or covars (N, 3, 3) m^2; opacities (N,);
    colors (N, C); viewmats (B, 4, 4) camera_from_world; Ks (B, 3, 3) px; background (B, C) or None;
    layer_ids (N,) int32 in [0, L) or None; layers: L, 0 for the composite only; alone: the layers
    to render alone, in this order, with the first `alone_channels` features.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    background: Tensor | None
    width: int
    height: int
    layer_ids: Tensor | None
    layers: int
    alone: tuple[int, ...]
    alone_channels: int
    settings: SplatSettings


def make_scene(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    background: Tensor | None,
    width: int,
    height: int,
    layer_ids: Tensor | None,
    layers: int,
    alone: Sequence[int] | None,
    alone_channels: int | None,
    settings: SplatSettings,
) -> Scene:
    """Check what all backends rely on; the numbers of single Gaussians are left to `check_gaussians`.

    Raises UsageProblem for shapes and sizes that cannot be meant, BadData for numbers that cannot be
    rendered; both name the array, BadData also the row.
    """
    if (quats is None) != (scales is None) or (quats is None) == (covars is None):
        raise UsageProblem(
            "The shape of the Gaussians is given twice or not at all.",
            "quats, scales, covars",
            "Give quats and scales, or covars.",
        )
    if not (0 <= width <= _LARGEST_SIDE and 0 <= height <= _LARGEST_SIDE):
        raise UsageProblem(
            f"An image of {width} x {height} px is not possible.",
            "width, height",
            f"Use 0 to {_LARGEST_SIDE} px.",
        )
    viewmats = viewmats if viewmats.ndim == 3 else viewmats[None]
    Ks = Ks if Ks.ndim == 3 else Ks[None]
    n, b = means.shape[0] if means.ndim else 0, len(viewmats)
    Ks = Ks.expand(b, 3, 3) if len(Ks) == 1 and Ks.shape[1:] == (3, 3) else Ks
    c = colors.shape[-1] if colors.ndim == 2 else 0
    if background is not None:
        background = (
            background.expand(b, c) if background.ndim == 1 and background.shape[0] == c else background
        )
    expected: list[tuple[str, Tensor | None, tuple[int, ...]]] = [
        ("means", means, (n, 3)),
        ("quats", quats, (n, 4)),
        ("scales", scales, (n, 3)),
        ("covars", covars, (n, 3, 3)),
        ("opacities", opacities, (n,)),
        ("colors", colors, (n, c)),
        ("viewmats", viewmats, (b, 4, 4)),
        ("Ks", Ks, (b, 3, 3)),
        ("background", background, (b, c)),
    ]
    for name, array, shape in expected:
        if array is not None and tuple(array.shape) != shape:
            raise UsageProblem(
                f"{name} has shape {tuple(array.shape)}; {shape} is needed.",
                name,
                "Give one row per Gaussian (camera).",
            )
    for name, array in (("colors", colors), ("viewmats", viewmats), ("Ks", Ks), ("background", background)):
        if array is not None:
            _check_finite(name, array)
    _check_intrinsics(Ks)
    chosen = tuple(range(layers) if alone is None else alone)
    features = c if alone_channels is None else alone_channels
    if layers:
        layer_ids = _checked_layers(layer_ids, n, layers)
        _check_alone(chosen, layers, features, c)
    return Scene(
        means, quats, scales, covars, opacities, colors, viewmats, Ks, background,
        int(width), int(height), layer_ids, layers, chosen, features if chosen else 0, settings,
    )  # fmt: skip


def _check_finite(name: str, array: Tensor) -> None:
    """NaN and infinity survive a sum, so that one cheap number clears the array in the usual case."""
    with torch.no_grad():
        if array.numel() == 0 or bool(torch.isfinite(array.detach().sum())):
            return
        bad = (~torch.isfinite(array)).nonzero()
        if len(bad):
            raise _bad_row(name, bad[0].tolist(), "is not a finite number")


def check_gaussians(scene: Scene) -> None:
    """Refuse numbers of single Gaussians that cannot be rendered, naming array and row (BadData)."""
    for name in ("means", "quats", "scales", "covars", "opacities"):
        array = getattr(scene, name)
        if array is not None:
            _check_finite(name, array)
    with torch.no_grad():
        _refuse("opacities", (scene.opacities < 0) | (scene.opacities > 1), "is outside [0, 1]")
        if scene.quats is not None:
            short = scene.quats.abs().amax(1) < SHORTEST_QUATERNION
            _refuse("quats", short, "is zero: it has no direction")
        if scene.covars is not None:
            variances = scene.covars.diagonal(dim1=1, dim2=2)
            _refuse("covars", (variances < 0).any(1), "has a negative variance")


def _check_intrinsics(Ks: Tensor) -> None:
    with torch.no_grad():
        _refuse("Ks", (Ks[:, [0, 1], [0, 1]] <= 0).any(1), "has a focal length that is not positive")
        _refuse("Ks", Ks[:, 0, 1] != 0, "has skew, which is not supported")


def _refuse(name: str, bad: Tensor, problem: str) -> None:
    if bool(bad.any()):
        raise _bad_row(name, bad.nonzero()[0].tolist(), problem)


def _checked_layers(layer_ids: Tensor | None, n: int, layers: int) -> Tensor:
    if layer_ids is None or tuple(layer_ids.shape) != (n,) or layer_ids.is_floating_point():
        raise UsageProblem("layer_ids must be N integers.", "layer_ids", "Give the layer of every Gaussian.")
    if n and (int(layer_ids.min()) < 0 or int(layer_ids.max()) >= layers):
        bad = ((layer_ids < 0) | (layer_ids >= layers)).nonzero()[0].tolist()
        raise _bad_row("layer_ids", bad, f"is outside [0, {layers})")
    return layer_ids.to(torch.int32)


def _check_alone(alone: tuple[int, ...], layers: int, features: int, channels: int) -> None:
    if len(set(alone)) != len(alone) or not all(0 <= layer < layers for layer in alone):
        raise UsageProblem(
            f"Layers {list(alone)} of {layers} cannot be rendered alone.",
            "alone",
            f"Give different numbers from 0 to {layers - 1}.",
        )
    if not 0 <= features <= channels:
        raise UsageProblem(
            f"Layers alone cannot have {features} of {channels} features.",
            "alone_channels",
            f"Use 0 (alpha and depth only) to {channels}.",
        )


def _bad_row(name: str, index: list[int], problem: str) -> BadData:
    where = name + "".join(f"[{i}]" for i in index)
    return BadData(f"{where} {problem}.", where, "Look for the step that wrote it; nothing was rendered.")
