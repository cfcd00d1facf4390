"""All functions of the stability table, one module per family."""

from __future__ import annotations

from stages.stability.function import Function
from stages.stability.functions.avatars import AVATARS
from stages.stability.functions.bundles import BUNDLES
from stages.stability.functions.fields import FIELDS
from stages.stability.functions.losses import LOSSES
from stages.stability.functions.normals import NORMALS
from stages.stability.functions.projection import PROJECTION
from stages.stability.functions.rotations import ROTATIONS
from stages.stability.functions.skinning import SKINNING
from stages.stability.functions.splatting import SPLATTING

FUNCTIONS: tuple[Function, ...] = (
    *ROTATIONS,
    *SKINNING,
    *FIELDS,
    *PROJECTION,
    *SPLATTING,
    *NORMALS,
    *AVATARS,
    *LOSSES,
    *BUNDLES,
)
FAMILIES = tuple(dict.fromkeys(function.family for function in FUNCTIONS))
