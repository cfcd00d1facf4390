"""Body model files: SMPL-X-convention `.npz`, our own safetensors, and the one inside the package."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from stages.shared.body.model import BodyModel, check_parents
from stages.shared.body.npz import NumericNpz
from stages.shared.body.skeleton import EXPRESSION_COUNT, SHAPE_COUNT
from stages.shared.errors import BadData, MissingInput

EMBEDDED_FILE = Path(__file__).with_name("data") / "body.safetensors"

# In SMPL-X files expression follows 300 shape columns, in the older ones 10.
_FULL_SHAPE_COLUMNS = 300
_SHORT_COLUMNS = 20


def load_body(path: Path) -> BodyModel:
    """Read a body model from `path`.

    `.npz` in the SMPL-X layout: v_template (V,3), f (F,3), shapedirs (V,3,10|20|400|…), J_regressor (55,V),
    weights (V,55), kintree_table (2,55); optional posedirs (V,3,486), hands_componentsl/r (45,45),
    hands_meanl/r (45,). Only these keys are read. Of the shape columns the first 10 are used, of the
    expression columns (from 300 in full files, from 10 in files with 20) the first 10.
    `.safetensors`: as written from `BodyModel.to_arrays`.

    Raises:
        MissingInput: no such file.
        BadData: a pickle, missing or object arrays, other skeletons, shapes that do not fit, NaN.
    """
    path = Path(path)
    if path.suffix == ".safetensors":
        return _load_safetensors(path)
    with NumericNpz(path, "a body model") as file:
        arrays = {
            "template_vertices": file.numbers("v_template"),
            "faces": file.numbers("f").astype(np.int64),
            "joint_regressor": file.numbers("J_regressor"),
            "skin_weights": file.numbers("weights"),
            **_shape_and_expression(file),
        }
        if "kintree_table" in file:
            check_parents(np.atleast_2d(file.numbers("kintree_table"))[0], str(path))
        if "posedirs" in file:
            directions = np.atleast_1d(file.numbers("posedirs"))
            arrays["pose_directions"] = directions.reshape(-1, directions.shape[-1]).T
        for ours, theirs in (
            ("hand_components_left", "hands_componentsl"),
            ("hand_components_right", "hands_componentsr"),
            ("hand_mean_left", "hands_meanl"),
            ("hand_mean_right", "hands_meanr"),
        ):
            if theirs in file:
                arrays[ours] = file.numbers(theirs)
    weights = arrays["skin_weights"].astype(np.float64)
    if weights.ndim == 2 and weights.size and weights.sum(axis=1).min() > 0.5:
        # Files in half precision or rounded text are a few 1e-4 off; skinning needs a partition of one.
        arrays["skin_weights"] = weights / weights.sum(axis=1, keepdims=True)
    return BodyModel.from_arrays(arrays, source=str(path))


@cache
def embedded_body() -> BodyModel:
    """The free body model inside the package (see `data/PROVENANCE.md`); it is read once."""
    from stages.shared.body.packed import unpack_body

    return unpack_body(EMBEDDED_FILE)


def _shape_and_expression(file: NumericNpz) -> dict[str, NDArray[Any]]:
    directions = file.numbers("shapedirs")
    columns = directions.shape[-1] if directions.ndim == 3 else 0
    if columns < SHAPE_COUNT:
        raise BadData(
            f"shapedirs has shape {directions.shape}; at least {SHAPE_COUNT} shape directions are needed.",
            f"{file.path}: shapedirs",
            "Give a body model with shapedirs (V, 3, 10) or more.",
        )
    arrays = {"shape_directions": directions[:, :, :SHAPE_COUNT]}
    first = SHAPE_COUNT if columns == _SHORT_COLUMNS else _FULL_SHAPE_COLUMNS
    if columns >= first + EXPRESSION_COUNT:
        arrays["expression_directions"] = directions[:, :, first : first + EXPRESSION_COUNT]
    return arrays


def _load_safetensors(path: Path) -> BodyModel:
    if not path.is_file():
        raise MissingInput("There is no file for a body model.", str(path), "Check the path.")
    try:
        arrays = load_file(path)
    except (SafetensorError, ValueError, OSError) as error:
        raise BadData(
            f"This file cannot be read as a body model: {error}.", str(path), "Write the file again."
        ) from error
    return BodyModel.from_arrays(arrays, source=str(path))
