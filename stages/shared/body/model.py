"""A body model in the SMPL-X convention, as plain arrays.

Rest frame: T-pose, metres, +y up, facing +z, the subject's left is +x.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.body.skeleton import JOINT_COUNT, JOINTS, PARENTS, SHAPE_COUNT, parents_array
from stages.shared.errors import BadData

Floats = NDArray[np.float32]

_OPTIONAL = (
    "expression_directions",
    "pose_directions",
    "hand_components_left",
    "hand_components_right",
    "hand_mean_left",
    "hand_mean_right",
)
_HAND_VALUES = 45  # axis-angle of the 15 joints of a hand
_REQUIRED = ("template_vertices", "faces", "shape_directions", "joint_regressor", "skin_weights")


@dataclass(frozen=True, eq=False)
class BodyModel:
    """Everything that linear blend skinning of a body needs.

    Attributes:
        template_vertices: (V, 3) f32, metres, rest frame, mean shape.
        faces: (F, 3) i32, outward normals by the right-hand rule.
        shape_directions: (V, 3, 10) f32, metres per unit of β.
        joint_regressor: (55, V) f32, rows sum to 1; joints = regressor @ shaped vertices.
        skin_weights: (V, 55) f32, ≥ 0, rows sum to 1.
        expression_directions: (V, 3, E) f32 metres per unit of expression, or None.
        pose_directions: (486, V·3) f32, metres per entry of the 54 matrices R − I, or None.
        hand_components_left, hand_components_right: (K, 45) f32 axis-angle per coefficient, or None.
        hand_mean_left, hand_mean_right: (45,) f32 axis-angle of the relaxed hand, or None.
        source: where it came from, in a word or two; not part of the digest.
    """

    template_vertices: Floats
    faces: NDArray[np.int32]
    shape_directions: Floats
    joint_regressor: Floats
    skin_weights: Floats
    expression_directions: Floats | None = None
    pose_directions: Floats | None = None
    hand_components_left: Floats | None = None
    hand_components_right: Floats | None = None
    hand_mean_left: Floats | None = None
    hand_mean_right: Floats | None = None
    source: str = ""

    @property
    def parents(self) -> NDArray[np.int32]:
        """(55,) i32, −1 for the root; always those of the SMPL-X convention."""
        return parents_array()

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The 55 names, in order."""
        return JOINTS

    @cached_property
    def joint_template(self) -> NDArray[np.float64]:
        """(55, 3) f64, metres: joints of the mean shape in the rest frame."""
        return self.joint_regressor.astype(np.float64) @ self.template_vertices.astype(np.float64)

    @cached_property
    def joint_directions(self) -> NDArray[np.float64]:
        """(55, 3, 10) f64, metres per unit of β: how the rest joints move with the shape."""
        return np.einsum(
            "jv,vcb->jcb", self.joint_regressor, self.shape_directions, dtype=np.float64, optimize=True
        )

    @cached_property
    def joint_expression_directions(self) -> NDArray[np.float64] | None:
        """(55, 3, E) f64, metres per unit of expression, or None."""
        if self.expression_directions is None:
            return None
        return np.einsum(
            "jv,vce->jce", self.joint_regressor, self.expression_directions, dtype=np.float64, optimize=True
        )

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of all arrays: two models with the same digest are the same model."""
        total = hashlib.sha256()
        for name, values in sorted(self.to_arrays().items()):
            total.update(f"{name} {values.dtype.str} {values.shape}".encode())
            total.update(np.ascontiguousarray(values).tobytes())
        return total.hexdigest()

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays that are there, under their attribute names (for safetensors)."""
        names = _REQUIRED + tuple(name for name in _OPTIONAL if getattr(self, name) is not None)
        return {name: np.ascontiguousarray(getattr(self, name)) for name in names}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], source: str = "arrays") -> BodyModel:
        """Inverse of `to_arrays`. Raises BadData when an array is missing or does not fit the others."""
        missing = [name for name in _REQUIRED if name not in arrays]
        if missing:
            raise _bad(f"The body model lacks {', '.join(missing)}.", source)
        floats = {name: arrays[name].astype(np.float32) for name in _REQUIRED if name != "faces"}
        optional = {name: arrays[name].astype(np.float32) for name in _OPTIONAL if name in arrays}
        model = cls(faces=arrays["faces"].astype(np.int32), **floats, **optional, source=source)
        _check(model)
        return model


def _check(model: BodyModel) -> None:
    """Refuse a model whose arrays do not fit together."""
    count = len(np.atleast_1d(model.template_vertices))
    expected = {
        "template_vertices": (count, 3),
        "shape_directions": (count, 3, SHAPE_COUNT),
        "joint_regressor": (JOINT_COUNT, count),
        "skin_weights": (count, JOINT_COUNT),
    }
    if model.expression_directions is not None:
        expected["expression_directions"] = (count, 3, model.expression_directions.shape[-1])
    if model.pose_directions is not None:
        expected["pose_directions"] = ((JOINT_COUNT - 1) * 9, count * 3)
    for side in ("left", "right"):
        components, mean = (getattr(model, f"hand_{part}_{side}") for part in ("components", "mean"))
        if components is not None:
            expected[f"hand_components_{side}"] = (*components.shape[:1], _HAND_VALUES)
        if mean is not None:
            expected[f"hand_mean_{side}"] = (_HAND_VALUES,)
    for name, shape in expected.items():
        values = getattr(model, name)
        if values.shape != shape:
            raise _bad(f"{name} has shape {values.shape}, expected {shape}.", model.source)
        if not np.isfinite(values).all():
            index = "".join(f"[{i}]" for i in np.argwhere(~np.isfinite(values))[0])
            raise _bad(f"{name}{index} is NaN or infinity.", model.source)
    faces = model.faces
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise _bad(f"faces have shape {faces.shape}, expected (F, 3) with F > 0.", model.source)
    if faces.min() < 0 or faces.max() >= count:
        raise _bad(f"faces point outside the {count} vertices.", model.source)
    for name, axis_sum in (
        ("skin_weights", model.skin_weights.sum(axis=1)),
        ("joint_regressor", model.joint_regressor.sum(axis=1)),
    ):
        if np.abs(axis_sum - 1).max() > 1e-2:
            raise _bad(
                f"Rows of {name} do not sum to 1.", f"{model.source}, row {np.abs(axis_sum - 1).argmax()}"
            )
    if model.skin_weights.min() < -1e-6:
        raise _bad("skin_weights contain negative values.", model.source)


def check_parents(parents: NDArray[Any], source: str) -> None:
    """Raise BadData unless `parents` (55,) are those of SMPL-X (the root may be −1 or 2³²−1)."""
    flat = np.asarray(parents).reshape(-1).astype(np.int64)
    if len(flat) != JOINT_COUNT:
        kind = {24: "SMPL", 52: "SMPL-H", 22: "a body without hands"}.get(len(flat), "not SMPL-X")
        raise _bad(f"The body model has {len(flat)} joints ({kind}); the SMPL-X convention has 55.", source)
    wrong = [joint for joint in range(1, JOINT_COUNT) if flat[joint] != PARENTS[joint]]
    if wrong:
        joint = wrong[0]
        raise _bad(
            f"Joint {joint} hangs on joint {flat[joint]}, in the SMPL-X convention on {PARENTS[joint]}.",
            source,
        )


def _bad(what: str, where: str) -> BadData:
    return BadData(
        what, where, "Give a body model in the SMPL-X convention (55 joints, 10 or more shape directions)."
    )
