"""What `gw train` reads of a subject: stages before it, the capture, and a subject to start from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import BodyModel
from stages.shared.capture import LAYERS, Capture, Take
from stages.shared.capture.subject import open_subject_capture
from stages.shared.errors import MissingInput
from stages.shared.poses import load_poses
from stages.train.config import METHODS, TrainConfig
from stages.train.method import MethodLayers, method_layers
from stages.train.start import Start, read_start


@dataclass(frozen=True)
class Source:
    """Everything the stage reads."""

    registered: Artifact
    baked: Artifact
    capture: Capture
    take: Take
    start: Start

    @property
    def inputs(self) -> dict[str, Artifact | ExternalFiles]:
        groups = ("cameras", "images", "masks", "labels")
        files = {f"capture/{group}": self.capture.files(group, "train") for group in groups}
        inputs: dict[str, Artifact | ExternalFiles] = {
            "register-template": self.registered,
            "bake-maps": self.baked,
            **{name: ExternalFiles(name, self.capture.root, paths) for name, paths in files.items() if paths},
        }
        if self.start.files is not None:
            inputs[self.start.files.name] = self.start.files
        return inputs

    def layers(self, method: str) -> MethodLayers:
        """What a method learns: maps of the layers that are there, or those it makes of them."""
        betas = load_poses(self.registered.file("smpl_params.npz")).betas
        found = method_layers(method, _baked_maps(self.baked), torch.from_numpy(betas))
        begun = {name: worn.maps for name, worn in self.start.layers.items()}
        return MethodLayers({**found.maps, **begun}, found.layer_ids)

    def own_maps(self, method: str) -> dict[str, dict[str, np.ndarray]]:
        """Arrays of the maps that this run has beside those of bake-maps, by layer."""
        if method == METHODS[0]:
            return {name: worn.maps.arrays() for name, worn in self.start.layers.items()}
        layers = self.layers(method)
        found = {name: maps.arrays() for name, maps in layers.maps.items()}
        for name, ids in layers.layer_ids.items():
            found[name]["layer_ids"] = ids.numpy().astype(np.int32)
        return found


def open_source(workspace: Workspace, config: TrainConfig, from_subject: Path | None = None) -> Source:
    """What a run of `config` reads.

    Raises:
        MissingInput: an earlier stage has not run, or the capture has changed. Others: as `read_start`.
    """
    registered, baked = workspace.require(REGISTER_TEMPLATE), workspace.require(BAKE_MAPS)
    start = Start()
    if from_subject is not None:
        start = read_start(from_subject, workspace, registered, _baked_maps(baked), config)
    body = BodyModel.from_arrays(registered.arrays("body.safetensors"))
    capture = open_subject_capture(workspace, body)
    name = registered.summary.get("take")
    takes = {take.name: take for take in capture.training_takes}
    if name not in takes:
        raise MissingInput(
            f"The capture has no training take called {name!r} any more.",
            str(capture.root),
            "Register the subject again with `gw register-template`.",
        )
    return Source(registered, baked, capture, takes[name], start)


def _baked_maps(baked: Artifact) -> dict[str, LayerMaps]:
    """Maps of the layers that are there, inner to outer."""
    layers = [name for name in LAYERS if name in baked.summary["layers"]]
    return {name: LayerMaps.load(baked, name) for name in layers}
