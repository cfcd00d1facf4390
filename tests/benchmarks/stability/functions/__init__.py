"""All functions of the stability table, one module per family."""

from __future__ import annotations

from tests.benchmarks.stability.function import Function
from tests.benchmarks.stability.functions.avatars import AVATARS
from tests.benchmarks.stability.functions.bundles import BUNDLES
from tests.benchmarks.stability.functions.fields import FIELDS
from tests.benchmarks.stability.functions.losses import LOSSES
from tests.benchmarks.stability.functions.normals import NORMALS
from tests.benchmarks.stability.functions.projection import PROJECTION
from tests.benchmarks.stability.functions.rotations import ROTATIONS
from tests.benchmarks.stability.functions.skinning import SKINNING
from tests.benchmarks.stability.functions.splatting import SPLATTING

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
