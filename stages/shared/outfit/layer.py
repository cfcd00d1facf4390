"""One layer ready to be worn: its maps, its model, and where it goes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.artifacts import Artifact
from stages.shared.artifacts.bundle import Bundle
from stages.shared.artifacts.bundle_precision import whole
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.registry import load_decoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.cloth.material import Material
from stages.shared.cloth.pattern import ClothPattern
from stages.shared.errors import BadData
from stages.shared.layers import SLOTS, label_of


@dataclass(frozen=True, eq=False)
class BodyUnderGarment:
    """The source's body under a garment: attributes of the body texels that the garment covers.

    Attributes:
        texels: (K, 3) int64 view, row, column on the global grid, sorted.
        offsets: (K, 3) m canonical. quaternions: (K, 4) unit wxyz. Means over the training poses.
    """

    texels: Tensor
    offsets: Tensor
    quaternions: Tensor


@dataclass(frozen=True, eq=False)
class Skin:
    """What a body's texels are where no clothes cover them: spread from the skin that was seen.

    Attributes:
        covered: (N,) how much each texel was covered when it was learned, 0..1.
        offsets: (N, 3) m canonical. colors: (N, 3) sRGB 0..1.
    """

    covered: Tensor
    offsets: Tensor
    colors: Tensor


@dataclass(frozen=True, eq=False)
class WornLayer:
    """A body or a garment.

    Attributes:
        name: "body", "lower", "upper" or "outer"; of a baseline also "whole" or "clothing".
        slots: layers it takes up; () for a body.
        maps, model: as trained.
        source: digest of the training it comes from, to tell pieces that were learned together.
        beneath: of a garment, when its bundle carries it. skin: of a body, the same.
        layer_ids: (N,) index into LAYERS of every texel, where a baseline's layer holds several.
        drive: what "auto" means for it, of `driver.DRIVES`.
        cloth: how it is simulated; None for a layer that cannot be.
    """

    name: str
    slots: tuple[str, ...]
    maps: LayerMaps
    model: Decoder
    source: str = ""
    beneath: BodyUnderGarment | None = None
    skin: Skin | None = None
    layer_ids: Tensor | None = None
    drive: str = "learned"
    cloth: ClothPattern | None = None

    @property
    def label(self) -> int:
        """Its id in label images; the body counts as skin."""
        return label_of(self.name)


def check_bundle_model(bundle: Bundle, where: str) -> None:
    """Raise BadData unless the model's tensors have the shapes that its configuration and maps ask for."""
    layer_of_bundle(bundle, where)


def layer_of_bundle(bundle: Bundle, where: str = "bundle") -> WornLayer:
    """The layer in a bundle.

    Arguments:
        where: the file, for messages.

    Raises:
        BadData: model, tensors and maps do not fit together.
    """
    manifest, bundle = bundle.manifest, replace(bundle, arrays=whole(bundle.arrays))
    grid = manifest["grid"]
    maps = LayerMaps.from_arrays(
        bundle.layer, bundle.group("maps"), grid["pitch"], grid["centre"], grid["size"]
    )
    try:
        model = _model(manifest["model"], maps, bundle.group("model"))
    except BadData as error:
        raise BadData(error.what, f"{where}, {error.where}", error.fix) from error
    beneath = None
    swap = bundle.group("swap")
    if swap and len(swap["texels"]):
        beneath = BodyUnderGarment(
            torch.from_numpy(swap["texels"].astype(np.int64)),
            torch.from_numpy(swap["offsets"].copy()),
            torch.from_numpy(swap["quaternions"].copy()),
        )
    skin = None
    if bare := bundle.group("skin"):
        skin = Skin(*(torch.from_numpy(bare[name].copy()) for name in ("covered", "offsets", "colors")))
    source = str(manifest["training"].get("source", ""))
    layer = WornLayer(bundle.layer, tuple(manifest["slots"]), maps, model, source, beneath, skin)
    if "cloth" not in manifest:
        return layer
    material = Material.from_json(manifest["cloth"]["material"], where)
    pattern = ClothPattern.from_arrays(
        bundle.group("cloth"), material, bundle.arrays["betas"], len(maps), where
    )
    return replace(layer, cloth=pattern, drive=manifest["cloth"]["drive"])


def layer_of_training(name: str, baked: Artifact, trained: Artifact) -> WornLayer:
    """A layer of a trained subject, from its bake-maps and train artifacts.

    Layers of a baseline, and those that another subject's training began, have maps of their own.
    """
    described = trained.json("model.json")
    config, ids = described["layers"][name], None
    if trained.has(f"maps-{name}.safetensors"):
        arrays = trained.arrays(f"maps-{name}.safetensors")
        grid = described.get("grids", {}).get(name, baked.summary)
        maps = LayerMaps.from_arrays(name, arrays, grid["pitch"], grid["centre"], grid["grid_size"])
        if "layer_ids" in arrays:
            ids = torch.from_numpy(arrays["layer_ids"].astype(np.int64))
    else:
        maps = LayerMaps.load(baked, name)
    model = _model(config, maps, trained.arrays(f"{name}.safetensors"))
    slots = (name,) if name in SLOTS else ()
    return WornLayer(name, slots, maps, model, trained.digest, layer_ids=ids)


def with_cloth(layer: WornLayer, fitted: Artifact, betas: NDArray[np.float32]) -> WornLayer:
    """The layer with its simulation mesh and its default driver from a fit-cloth artifact, if it has them.

    Arguments:
        betas: (10,) shape of the subject.
    """
    garments = fitted.json("cloth.json")["garments"]
    if layer.name not in garments:
        return layer
    entry, where = garments[layer.name], f"cloth of {layer.name}"
    material = Material.from_json(entry["material"], where)
    arrays = fitted.arrays(f"{layer.name}.safetensors")
    pattern = ClothPattern.from_arrays(arrays, material, betas, len(layer.maps), where)
    return replace(layer, cloth=pattern, drive=str(entry["drive"]))


def _model(config: dict[str, Any], maps: LayerMaps, arrays: dict[str, np.ndarray]) -> Decoder:
    tensors = {name: torch.from_numpy(np.array(array, dtype=np.float32)) for name, array in arrays.items()}
    model = load_decoder(config, maps, tensors).eval()
    for parameter in model.parameters():
        parameter.requires_grad_(False)
    return model
