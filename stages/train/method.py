"""The method of a run, and the baselines in the same framework: same maps, pictures and budget.

The baselines always have their networks, also in presets that go without.

- "gaussian-wardrobe": a layer for the body and one for every garment.
- "animatable-gaussians": the whole clothed person is one layer, its shape is not removed, and no loss knows
  of layers (Li et al. 2024). The layer is the outermost surface of all layers' maps, which is what rays
  through the template as a whole would meet. Kept from this project: wrists turned in the canonical pose,
  fingers in the positional map, SSIM and optical flow in the loss.
- "layga": the body, and one layer of clothing that starts on the body's own surface, with smoothness and
  collision terms (after Lin et al. 2024, whose code is not public). An approximation: what hangs free of the
  body, as a skirt between the legs, has no texels of its own; there is no first stage with one layer, and the
  collision is this project's penetration term.

The texels of both remember which layer's surface they are, so that their label pictures can be scored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from stages.shared.avatar.config import NETWORKS
from stages.shared.avatar.decoders.registry import decoder_class
from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import BODY, CLOTHING, LAYER_OF_LABEL, LAYERS, WHOLE
from stages.train.ablation import ablated
from stages.train.config import METHODS, TrainConfig
from stages.train.window import SMALLEST

BASELINE_DECODER = "styleunet"
_PUBLISHED_OFFSET = 0.005
_POKES_THROUGH = 0.01  # m: a fitted body that is in front of cloth by less than this lies beneath it
_LARGEST_STEP = 0.03  # m in depth between neighbouring texels
_OUT_OF_SKIN = 0.005  # m


@dataclass(frozen=True)
class MethodLayers:
    """What a method learns.

    Attributes:
        maps: name to maps, inner to outer.
        layer_ids: name to (N,) int64 index into LAYERS of every texel, for layers that hold several.
    """

    maps: dict[str, LayerMaps]
    layer_ids: dict[str, Tensor]


def settled(config: TrainConfig) -> TrainConfig:
    """The configuration as the method and the parts left out change it; doing it twice changes nothing.

    Raises:
        UsageProblem: unknown method, decoder or part; a baseline with blendshapes.
    """
    if config.method not in METHODS:
        raise UsageProblem(
            f"There is no method {config.method!r}.",
            "option --method",
            "Choose of: " + ", ".join(METHODS) + ".",
        )
    if 0 < config.patch < SMALLEST:
        raise UsageProblem(
            f"A window of {config.patch} px is too small to learn from.",
            "option --patch",
            f"Give at least {SMALLEST}, or 0 for whole pictures.",
        )
    if config.model.networks not in NETWORKS:
        raise UsageProblem(
            f"No layers are called {config.model.networks!r}.",
            "option --networks",
            f"Choose of {', '.join(NETWORKS)}.",
        )
    config = _with_decoder(config)
    weights = config.weights
    if config.method == "animatable-gaussians":
        weights = replace(
            weights,
            offset=_PUBLISHED_OFFSET,
            label=0.0,
            silhouette=0.0,
            penetration=0.0,
            opacity=0.0,
            covered_skin=0.0,
        )
    if config.method != METHODS[0]:  # the baselines are networks; without them they would be something else
        config = replace(config, model=replace(config.model, networks="all"))
    if config.method == "layga":  # clothing has to leave the skin, by centimetres
        weights = replace(weights, offset=_PUBLISHED_OFFSET)
    return ablated(replace(config, weights=weights))


def _with_decoder(config: TrainConfig) -> TrainConfig:
    """Without the settings that the decoder does not have."""
    decoder = decoder_class(config.model.decoder)
    if config.method != METHODS[0] and config.model.decoder != BASELINE_DECODER:
        raise UsageProblem(
            f"The baseline {config.method} is made of networks.",
            "options --method and --decoder",
            "Leave one of them out.",
        )
    track = config.track if decoder.followed else replace(config.track, frame_step=0)
    return replace(config, model=decoder.resolved(config.model), track=track)


def method_layers(method: str, maps: dict[str, LayerMaps], betas: Tensor) -> MethodLayers:
    """The layers that a method learns, from the baked ones.

    Arguments:
        maps: baked layers, inner to outer. betas: (10,) shape of the subject.

    Raises:
        MissingInput: a baseline needs a layer that is not there.
    """
    if method == "animatable-gaussians":
        whole, ids = whole_layer(list(maps.values()), betas)
        return MethodLayers({WHOLE: whole}, {WHOLE: ids})
    if method == "layga":
        garments = [layer for name, layer in maps.items() if name != BODY]
        if BODY not in maps or not garments:
            raise MissingInput(
                "LayGA needs a body and a garment.", "layers of bake-maps", "Choose another --method."
            )
        clothing, ids = clothing_layer(maps[BODY], garments)
        return MethodLayers({BODY: maps[BODY], CLOTHING: clothing}, {CLOTHING: ids})
    return MethodLayers(maps, {})


def layer_of_label(names: Sequence[str]) -> dict[int, str]:
    """Label id to the layer of these that shows it; the clothing of LayGA shows all garments."""
    if CLOTHING in names:
        return {label: layer if layer == BODY else CLOTHING for label, layer in LAYER_OF_LABEL.items()}
    return {label: layer for label, layer in LAYER_OF_LABEL.items() if layer in names}


def whole_layer(layers: Sequence[LayerMaps], betas: Tensor) -> tuple[LayerMaps, Tensor]:
    """One layer of the outermost texels of all, with the subject's shape in it, and whose each is
    (N,), as an index into LAYERS.

    Arguments:
        layers: maps on one grid, inner to outer. betas: (10,).
    """
    outermost = _outermost(layers)
    joined = _joined(layers, WHOLE)
    maps = _selected(joined, outermost)
    shaped = maps.positions + torch.einsum("b,nbk->nk", betas, maps.shape_directions)
    ids = torch.cat([torch.full((len(layer),), LAYERS.index(layer.layer)) for layer in layers])[outermost]
    maps = replace(
        maps,
        positions=shaped,
        shape_directions=torch.zeros_like(maps.shape_directions),
        neighbours=_neighbours(maps),
    )
    return maps, ids


def clothing_layer(body: LayerMaps, garments: Sequence[LayerMaps]) -> tuple[LayerMaps, Tensor]:
    """The body's texels beneath garments as a layer just outside the skin, and whose each is
    (N,), as an index into LAYERS.

    Colours and labels are those of the outermost garment at the same pixel.
    """
    covered = (body.covered_by(list(garments)) & (body.texels[:, 0] < 2)).nonzero()[:, 0]
    if not len(covered):
        raise MissingInput("No garment lies over the body.", "maps of bake-maps", "Choose another --method.")
    maps = replace(_selected(body, covered), layer=CLOTHING)
    outermost = _outermost(garments)
    shown = torch.cat([layer.pixel_ids() for layer in garments])[outermost]
    place = outermost[torch.searchsorted(shown, maps.pixel_ids())]
    ids = torch.cat([torch.full((len(layer),), LAYERS.index(layer.layer)) for layer in garments])[place]
    return replace(
        maps,
        positions=maps.positions + _OUT_OF_SKIN * maps.normals,
        colors=torch.cat([layer.colors for layer in garments])[place],
        color_confidence=torch.cat([layer.color_confidence for layer in garments])[place],
    ), ids


def _outermost(layers: Sequence[LayerMaps]) -> Tensor:
    """Indices into all layers' texels in a row: the outermost at each pixel of each view, in pixel order."""
    pixels = torch.cat([layer.pixel_ids() for layer in layers])
    view = torch.cat([layer.texels[:, 0] for layer in layers])
    height = torch.cat([layer.positions[:, 2] + index * _POKES_THROUGH for index, layer in enumerate(layers)])
    back = torch.cat([-layer.positions[:, 2] + index * _POKES_THROUGH for index, layer in enumerate(layers)])
    order = torch.argsort(torch.where(view == 0, height, back), descending=True, stable=True)
    order = order[view[order] < 2]  # further sheets of a layer lie inside it
    order = order[torch.argsort(pixels[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool)
    first[1:] = pixels[order][1:] != pixels[order][:-1]
    return order[first]


def _joined(layers: Sequence[LayerMaps], name: str) -> LayerMaps:
    """All layers' texels in a row, with the smallest window that holds them; links keep their ends."""
    starts = [0]
    for layer in layers:
        starts.append(starts[-1] + len(layer))
    values: dict[str, Any] = {}
    for field in _per_texel(layers[0]):
        values[field] = torch.cat([getattr(layer, field) for layer in layers])
    values["neighbours"] = torch.cat(
        [
            torch.where(layer.neighbours >= 0, layer.neighbours + start, -1)
            for layer, start in zip(layers, starts, strict=False)
        ]
    )
    values["seams"] = torch.cat([layer.seams + start for layer, start in zip(layers, starts, strict=False)])
    return replace(layers[0], layer=name, window=_window(values["texels"]), **values)


def _selected(maps: LayerMaps, chosen: Tensor) -> LayerMaps:
    """The texels `chosen` (K,), with the links between them."""
    number = torch.full((len(maps) + 1,), -1)  # the last one stands for "none"
    number[chosen] = torch.arange(len(chosen))
    seams = number[maps.seams]
    values: dict[str, Any] = {field: getattr(maps, field)[chosen] for field in _per_texel(maps)}
    values["neighbours"] = number[maps.neighbours[chosen]]
    values["seams"] = seams[(seams >= 0).all(dim=1)]
    return replace(maps, window=_window(values["texels"]), **values)


def _neighbours(maps: LayerMaps) -> Tensor:
    """(N, 4) texel up, right, down, left in the same view; −1 where none is, or across a step in depth."""
    view, row, column = maps.window_texels
    height, width = maps.window[2:]
    numbers = torch.full((2, height + 2, width + 2), -1)
    numbers[view, row + 1, column + 1] = torch.arange(len(maps))
    beside = [numbers[view, row + 1 + r, column + 1 + c] for r, c in ((-1, 0), (0, 1), (1, 0), (0, -1))]
    found = torch.stack(beside, dim=1)
    depth = maps.positions[:, 2]
    far = (depth[found] - depth[:, None]).abs() > max(_LARGEST_STEP, 3 * maps.pitch)
    return torch.where((found >= 0) & ~far, found, -1)


def _window(texels: Tensor) -> tuple[int, int, int, int]:
    low, high = texels[:, 1:].min(dim=0).values, texels[:, 1:].max(dim=0).values
    row, column, last_row, last_column = (int(value) for value in torch.cat((low, high)))
    return row, column, last_row - row + 1, last_column - column + 1


def _per_texel(maps: LayerMaps) -> list[str]:
    """Names of the tensors with a row per texel that mean the same in any selection."""
    linked = ("neighbours", "seams")
    names = [
        f.name for f in fields(maps) if isinstance(getattr(maps, f.name), Tensor) and f.name not in linked
    ]
    return [name for name in names if len(getattr(maps, name)) == len(maps)]
