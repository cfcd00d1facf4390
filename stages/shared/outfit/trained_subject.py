"""Which fit-cloth artifact of a subject belongs to its present training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.pipeline import BAKE_MAPS, DISTILL, FIT_CLOTH, REGISTER_TEMPLATE, TRAIN
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.body import BodyModel, Poses
from stages.shared.capture.exposure import Exposure, read_exposures
from stages.shared.layers import BASELINE_LAYERS, LAYERS
from stages.shared.outfit.layer import WornLayer, layer_of_training, with_cloth
from stages.shared.outfit.outfit import Outfit
from stages.shared.poses.read import load_poses


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


@dataclass(frozen=True)
class TrainedSubject:
    """Artifacts of one subject.

    Attributes:
        registered: of register-template. baked: of bake-maps. trained: of train, or of distill.
        cloth: of fit-cloth, when its garments can be simulated.
    """

    registered: Artifact
    baked: Artifact
    trained: Artifact
    cloth: Artifact | None = None

    @classmethod
    def open(cls, folder: Path, distilled: bool = False) -> TrainedSubject:
        """The artifacts in use; `distilled` for the blendshapes that `gw distill` made of the networks.

        Raises:
            MissingInput: one of the stages has not run.
        """
        workspace = Workspace(folder)
        specs = (REGISTER_TEMPLATE, BAKE_MAPS, DISTILL if distilled else TRAIN)
        registered, baked, trained = (workspace.require(spec) for spec in specs)
        return cls(registered, baked, trained, fitted_cloth(workspace))

    @property
    def artifacts(self) -> tuple[Artifact, Artifact, Artifact]:
        """Registration, maps and training, in the order of the pipeline."""
        return self.registered, self.baked, self.trained

    @property
    def digests(self) -> dict[str, str]:
        """Digest of every artifact by stage."""
        parts = (*self.artifacts, *(() if self.cloth is None else (self.cloth,)))
        return {part.stage: part.digest for part in parts}

    @property
    def exposures(self) -> dict[str, Exposure]:
        """What training cameras do to the colours; empty where they are alike, and after distillation."""
        name = "exposure.json"
        if not (self.trained.path / name).is_file():
            return {}
        return read_exposures(self.trained.json(name), str(self.trained.path / name))

    @property
    def layers(self) -> list[str]:
        """Names of the trained layers, inner to outer; those of a baseline last."""
        trained = self.trained.json("model.json")["layers"]
        return [name for name in (*LAYERS, *BASELINE_LAYERS) if name in trained]

    def body_model(self) -> BodyModel:
        """The body model that the subject was registered with."""
        return BodyModel.from_arrays(self.registered.arrays("body.safetensors"))

    def poses(self) -> Poses:
        """The motion of the template's take, with the shape of the subject."""
        return load_poses(self.registered.file("smpl_params.npz"), self.body_model())

    def layer(self, name: str) -> WornLayer:
        """One trained layer."""
        layer = layer_of_training(name, self.baked, self.trained)
        return layer if self.cloth is None else with_cloth(layer, self.cloth, self.poses().betas)

    def outfit(self) -> Outfit:
        """The subject in its own clothes."""
        return Outfit(self.body_model(), self.poses().betas, tuple(self.layer(name) for name in self.layers))
