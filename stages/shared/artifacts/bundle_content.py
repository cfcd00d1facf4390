"""The manifest and the arrays of a bundle: their meaning, and the values that are refused.

Manifest:
    kind            "body" or "garment"
    layer           "body", "lower", "upper" or "outer"
    slots           layers a garment takes up: ["lower"], or ["lower", "upper"] for a dress; [] for a body
    body_model      {"digest": hex, "convention": "SMPL-X", "joints": 55, "betas": 10}
    grid            {"pitch": m per texel, "centre": [x, y, z] m, "size": texels per side}
    units, frames   texts for people
    model           configuration of the layer's model
    training        configuration and scores, as trained
    note            a text
    cloth           (garment, since 1.2) material of the simulation mesh and the default driver
Arrays (N texels; since 1.1 f16 may stand for f32 where `bundle_precision.py` says so):
    maps/texels (N,3) i32 view (even front, odd back), row, column · maps/window (4,) i32
    maps/neighbours (N,4) i32 · maps/seams (S,2) i32
    maps/positions, maps/normals (N,3) f32 · maps/skin_weights (N,55) f32 · maps/shape_directions (N,10,3) f32
    maps/spacing, maps/color_confidence (N,) f32 · maps/colors (N,3) f32
    model/…         the model's tensors
    betas (10,) f32 shape of the person the layer was learned from
    swap/texels (K,3) i32, swap/offsets (K,3) f32 m, swap/quaternions (K,4) f32
                    (garment) the body of the source beneath the garment
    joints (55,3) f32 m, canonical, zero shape, of the body model it was learned with (since 1.1)
    skin/covered (N,), skin/offsets (N,3) m, skin/colors (N,3) f32
                    (body, since 1.1) how much clothes covered each texel; what it is where nothing does
    body/…          (body) the body model's arrays
    cloth/…         (garment, since 1.2) a simulation mesh, see `bundle_cloth.py`
    preview (H,W,3) u8 sRGB
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from stages.shared.artifacts.arrays import Arrays
from stages.shared.artifacts.bundle_cloth import check_cloth_entry, check_cloth_layout, check_cloth_values
from stages.shared.artifacts.bundle_model import check_model
from stages.shared.artifacts.bundle_precision import may_be_half
from stages.shared.errors import BadData
from stages.shared.layers import BODY, LAYERS, SLOTS
from stages.shared.texel_maps import ARRAYS, BOX, FLOATS, MAX_VIEWS, OTHER_ARRAYS, index_problem

JOINTS = 55
BETAS = 10
MAX_TEXELS = 2_000_000
MAX_GRID = 4096
LARGEST_PREVIEW = 2048

_SKIN: dict[str, tuple[tuple[int, ...], float, float]] = {
    "covered": ((), 0, 1),
    "offsets": ((3,), -1, 1),
    "colors": ((3,), -0.01, 1.01),
}
Layout = Mapping[str, tuple[str, tuple[int, ...]]]  # tensor name to type (F32, F16, I32, U8) and shape
_TYPES = {"float32": "F32", "float16": "F16", "int32": "I32", "uint8": "U8"}
_BODY = ("template_vertices", "faces", "shape_directions", "joint_regressor", "skin_weights")
_BODY_OPTIONAL = ("hand_components_left", "hand_components_right", "hand_mean_left", "hand_mean_right")


def check_manifest(manifest: dict[str, Any], where: str) -> None:
    """Raise BadData unless every field that is read later is there and of its kind."""
    allowed = {
        "kind": str,
        "layer": str,
        "slots": list,
        "body_model": dict,
        "grid": dict,
        "units": dict,
        "frames": dict,
        "model": dict,
        "training": dict,
        "note": str,
        "schema": dict,
        "tensors": dict,
    }
    for name, kind in allowed.items():
        if not isinstance(manifest.get(name), kind):
            raise _bad(f"its manifest lacks {name!r}, or it is not of its kind", where)
    kind, layer, slots = manifest["kind"], manifest["layer"], manifest["slots"]
    if kind not in ("body", "garment") or layer not in LAYERS or (kind == "body") != (layer == BODY):
        raise _bad(f"it is of kind {kind!r} and layer {layer!r}", where)
    fitting = [] if kind == "body" else [slot for slot in SLOTS if slot in slots]
    if slots != fitting or (kind == "garment" and layer not in slots):
        raise _bad(f"its slots {str(slots)[:80]} do not fit its layer {layer}", where)
    body = manifest["body_model"]
    digest = body.get("digest")
    if not isinstance(digest, str) or len(digest) != 64 or not set(digest) <= set("0123456789abcdef"):
        raise _bad("its body model has no digest", where)
    if body.get("joints") != JOINTS or body.get("betas") != BETAS:
        raise _bad(f"its body model has not {JOINTS} joints and {BETAS} shape directions", where)
    grid = manifest["grid"]
    pitch, size, centre = grid.get("pitch"), grid.get("size"), grid.get("centre")
    if not _is_number(pitch) or not 1e-4 <= pitch <= 0.1:
        raise _bad("the pitch of its grid is not between 0.1 mm and 10 cm", where)
    if type(size) is not int or not 1 <= size <= MAX_GRID:
        raise _bad(f"its grid does not have 1 to {MAX_GRID} texels a side", where)
    good_centre = isinstance(centre, list) and len(centre) == 3 and all(_is_number(x) for x in centre)
    if not good_centre or max(abs(x) for x in centre) > BOX:
        raise _bad("the centre of its grid is not a point near the body", where)
    check_model(manifest["model"], where)
    if manifest["model"].get("layer", layer) != layer:
        raise _bad(f"its model is that of another layer than {layer}", where)
    _check_training(manifest, where)
    if "cloth" in manifest:
        if kind == "body":
            raise _bad("a body carries a simulation mesh", where)
        check_cloth_entry(manifest["cloth"], where)


def _check_training(manifest: dict[str, Any], where: str) -> None:
    """Check what the manifest says about the training; every command that lists bundles shows it."""
    training, costs = manifest["training"], manifest.get("costs", {})
    for name, kind in (("source", str), ("config", dict), ("scores", dict)):
        if not isinstance(training.get(name, kind()), kind):
            raise _bad(f"what it says about its training is not understood (training.{name})", where)
    scores = training.get("scores", {})
    wrong = [name for name, value in scores.items() if isinstance(value, float) and not np.isfinite(value)]
    if wrong:
        raise _bad(f"a score of its training is not a finite number ({wrong[0][:40]!r})", where)
    if not isinstance(costs, dict) or not isinstance(costs.get("multiply_adds_per_frame", {}), dict):
        raise _bad("what it says about its costs is not understood (costs)", where)


def layout_of(arrays: Arrays) -> Layout:
    """Type and shape of every array, as the header of a bundle states them."""
    return {
        name: (_TYPES.get(str(array.dtype), str(array.dtype)), array.shape) for name, array in arrays.items()
    }


def check_layout(manifest: dict[str, Any], layout: Layout, where: str) -> None:
    """Raise BadData unless every tensor that is needed is there, with a type and a shape that fit the others.

    This needs the header of a file only; commands that list bundles check as much.
    """
    for name, (_, shape) in layout.items():
        if 0 in shape and name != "maps/seams" and not name.startswith("swap/"):
            raise _bad("a tensor is empty", where, name)
    count = _rows("maps/texels", layout, where)
    if not 1 <= count <= MAX_TEXELS:
        raise _bad(f"it has {count} texels, not 1 to {MAX_TEXELS}", where)
    if manifest["model"]["texels"] != count:
        raise _bad(f"its model has {manifest['model']['texels']} texels, its maps {count}", where)
    for name, array in ARRAYS.items():
        _expect(f"maps/{name}", layout, (count, *array.shape), array.kind, where)
    _expect("maps/window", layout, (4,), "i", where)
    _expect("maps/seams", layout, (_rows("maps/seams", layout, where), 2), "i", where)
    _expect("betas", layout, (BETAS,), "f", where)
    dtype, shape = layout.get("preview", ("", ()))
    if dtype != "U8" or len(shape) != 3 or shape[2] != 3:
        raise _bad("the preview is not an 8-bit colour picture", where, "preview")
    if max(shape) > LARGEST_PREVIEW:
        raise _bad(f"the preview is larger than {LARGEST_PREVIEW} pixels", where, "preview")
    if "joints" in layout:
        _expect("joints", layout, (JOINTS, 3), "f", where)
    groups = {name.split("/")[0] for name in layout}
    if manifest["kind"] == "body":
        _expect_body(layout, where)
    elif groups & {"body", "skin"}:
        raise _bad("a garment carries a body", where)
    if "swap" in groups:
        _expect_swap(manifest, layout, where)
    if "skin" in groups:
        for name, (tail, _, _) in _SKIN.items():
            _expect(f"skin/{name}", layout, (count, *tail), "f", where)
    if ("cloth" in groups) != ("cloth" in manifest):
        raise _bad("its manifest and its tensors disagree about a simulation mesh", where)
    if "cloth" in groups:
        cloth = {
            name.removeprefix("cloth/"): entry for name, entry in layout.items() if name.startswith("cloth/")
        }
        check_cloth_layout(cloth, count, where)
    known = {f"maps/{name}" for name in (*ARRAYS, *OTHER_ARRAYS)} | {"betas", "preview", "joints"}
    known |= {f"skin/{name}" for name in _SKIN}
    known |= {f"swap/{name}" for name in ("texels", "offsets", "quaternions")}
    known |= {f"body/{name}" for name in (*_BODY, *_BODY_OPTIONAL)}
    for name in layout:
        if name not in known and not name.startswith(("model/", "cloth/")):
            raise _bad("a tensor has a name that means nothing", where, name)


def _expect_body(layout: Layout, where: str) -> None:
    count = _rows("body/template_vertices", layout, where)
    shapes = {
        "template_vertices": (count, 3),
        "shape_directions": (count, 3, BETAS),
        "joint_regressor": (JOINTS, count),
        "skin_weights": (count, JOINTS),
    }
    for name, shape in shapes.items():
        _expect(f"body/{name}", layout, shape, "f", where)
    _expect("body/faces", layout, (_rows("body/faces", layout, where), 3), "i", where)


def _expect_swap(manifest: dict[str, Any], layout: Layout, where: str) -> None:
    if manifest["kind"] != "garment":
        raise _bad("a body carries what lies beneath a garment", where)
    count = _rows("swap/texels", layout, where)
    for name, columns, kind in (("texels", 3, "i"), ("offsets", 3, "f"), ("quaternions", 4, "f")):
        _expect(f"swap/{name}", layout, (count, columns), kind, where)


def check_arrays(manifest: dict[str, Any], arrays: Arrays, where: str) -> None:
    """Raise BadData unless the arrays are finite, fit together, and hold what their names say."""
    check_layout(manifest, layout_of(arrays), where)
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise _bad("a tensor holds NaN or infinity", where, name)
        if name.startswith("model/") and array.dtype.kind == "f" and float(np.abs(array).max()) > 1e6:
            raise _bad("a tensor of the model has values beyond a million", where, name)
    _check_maps(manifest["grid"]["size"], arrays, where)
    if np.abs(arrays["betas"]).max() > 20:
        raise _bad("a shape coefficient is beyond 20", where, "betas")
    if manifest["kind"] == "body":
        _check_body(arrays, where)
    if "swap/texels" in arrays:
        _check_swap(manifest["grid"]["size"], arrays, where)
    if "skin/covered" in arrays:
        for name, (_, low, high) in _SKIN.items():
            _check_range(arrays, f"skin/{name}", low, high, where)
    if "cloth/faces" in arrays:
        cloth = {name.removeprefix("cloth/"): a for name, a in arrays.items() if name.startswith("cloth/")}
        check_cloth_values(cloth, where)
    if "joints" in arrays and np.abs(arrays["joints"]).max() > BOX:
        raise _bad(f"a joint is farther than {BOX} m from the origin", where, "joints")


def _check_maps(grid_size: int, arrays: Arrays, where: str) -> None:
    maps = {name: arrays[f"maps/{name}"] for name in (*ARRAYS, *OTHER_ARRAYS)}
    if problem := index_problem(maps, grid_size):
        raise _bad(problem[0], where, f"maps/{problem[1]}")
    texels = maps["texels"].astype(np.int64)
    numbers = (texels[:, 0] * grid_size + texels[:, 1]) * grid_size + texels[:, 2]
    if (np.diff(numbers) <= 0).any():
        raise _bad("the texels are not in order, or one stands twice", where, "maps/texels")
    for name in FLOATS:
        _check_range(arrays, f"maps/{name}", ARRAYS[name].low, ARRAYS[name].high, where)
    _check_weights(maps["skin_weights"], 1e-3, where, "maps/skin_weights")
    lengths = np.linalg.norm(maps["normals"], axis=1)
    if lengths.min() < 0.5 or lengths.max() > 1.01:
        raise _bad("a normal does not have length one", where, "maps/normals")


def _check_body(arrays: Arrays, where: str) -> None:
    faces, vertices = arrays["body/faces"], arrays["body/template_vertices"]
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise _bad("the faces are not triples of vertices", where, "body/faces")
    _check_weights(arrays["body/skin_weights"], 1e-2, where, "body/skin_weights")
    if np.abs(arrays["body/joint_regressor"].sum(axis=1) - 1).max() > 1e-2:
        raise _bad("rows do not sum to one", where, "body/joint_regressor")
    if np.abs(vertices).max() > BOX:
        raise _bad(f"a point is farther than {BOX} m from the origin", where, "body/template_vertices")


def _check_swap(grid_size: int, arrays: Arrays, where: str) -> None:
    texels = arrays["swap/texels"]
    if not len(texels):
        return
    if texels.min() < 0 or texels.max() >= grid_size or texels[:, 0].max() >= MAX_VIEWS:
        raise _bad("a texel lies outside the grid", where, "swap/texels")
    if np.abs(arrays["swap/offsets"]).max() > 1:
        raise _bad("an offset is longer than a metre", where, "swap/offsets")
    if np.abs(np.linalg.norm(arrays["swap/quaternions"], axis=1) - 1).max() > 1e-3:
        raise _bad("a quaternion has not length one", where, "swap/quaternions")


def _check_range(arrays: Arrays, name: str, low: float, high: float, where: str) -> None:
    values = arrays[name]
    if values.min() < low or values.max() > high:
        raise _bad(f"a value is not between {low} and {high}", where, name)


def _check_weights(weights: np.ndarray, tolerance: float, where: str, name: str) -> None:
    if weights.min() < -1e-6 or np.abs(weights.sum(axis=1, dtype=np.float64) - 1).max() > tolerance:
        raise _bad("skinning weights are negative, or a row does not sum to one", where, name)


def _expect(name: str, layout: Layout, shape: tuple[int, ...], kind: str, where: str) -> None:
    _rows(name, layout, where)
    dtype, actual = layout[name]
    if actual != shape:
        raise _bad(f"the shape {actual} is not {shape}", where, name)
    allowed = {"I32"} if kind == "i" else {"F32", "F16"} if may_be_half(name) else {"F32"}
    if dtype not in allowed:
        raise _bad(f"the type {dtype} is not the one it must have", where, name)


def _rows(name: str, layout: Layout, where: str) -> int:
    """Length of a tensor's first axis."""
    if name not in layout or not layout[name][1]:
        raise _bad("a tensor is missing", where, name)
    return layout[name][1][0]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _bad(what: str, where: str, tensor: str | None = None) -> BadData:
    return BadData(
        f"The bundle cannot be used: {what}.",
        where if tensor is None else f"{where}, tensor {tensor!r}",
        "Fetch a whole copy, or export it again from its subject.",
    )
