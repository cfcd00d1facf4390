"""Which fit-cloth artifact of a subject belongs to its present training."""

from __future__ import annotations

from stages.pipeline import BAKE_MAPS, FIT_CLOTH, TRAIN
from stages.shared.artifacts import Artifact, Workspace


def fitted_cloth(workspace: Workspace) -> Artifact | None:
    """The fit-cloth artifact in use; None when there is none, or when it was fitted to another training."""
    fitted = workspace.current(FIT_CLOTH)
    if fitted is None:
        return None
    for spec in (BAKE_MAPS, TRAIN):
        made_from, present = fitted.manifest.inputs.get(spec.name), workspace.current(spec)
        if made_from is None or present is None or made_from.digest != present.digest:
            return None
    return fitted
