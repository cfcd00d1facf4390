"""The stages that write artifacts into a subject's workspace, in order."""

from __future__ import annotations

from stages.shared.artifacts.spec import StageSpec

REGISTER_TEMPLATE = StageSpec(
    "register-template", "gw register-template CAPTURE -o SUBJECT", (), code_version=4
)
CANONICALIZE = StageSpec("canonicalize", "gw canonicalize SUBJECT", ("register-template",), code_version=2)
SEGMENT_LAYERS = StageSpec(
    "segment-layers", "gw segment-layers SUBJECT", ("register-template", "canonicalize"), code_version=3
)
BAKE_MAPS = StageSpec("bake-maps", "gw bake-maps SUBJECT", ("canonicalize", "segment-layers"), code_version=2)
LABEL = StageSpec("label", "gw label SUBJECT", ("register-template",))
TRAIN = StageSpec("train", "gw train SUBJECT", ("register-template", "bake-maps"), code_version=9)
DISTILL = StageSpec(
    "distill", "gw distill SUBJECT", ("register-template", "bake-maps", "train"), code_version=2
)
FIT_CLOTH = StageSpec(
    "fit-cloth",
    "gw fit-cloth SUBJECT",
    ("register-template", "segment-layers", "bake-maps", "train"),
    code_version=7,
)

PIPELINE: tuple[StageSpec, ...] = (REGISTER_TEMPLATE, CANONICALIZE, SEGMENT_LAYERS, BAKE_MAPS, TRAIN)
OPTIONAL: tuple[StageSpec, ...] = (LABEL, DISTILL, FIT_CLOTH)
BY_NAME = {spec.name: spec for spec in PIPELINE + OPTIONAL}
