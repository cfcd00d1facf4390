"""What `gw train` reads of a subject: stages before it, the capture, and a subject to start from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import BodyModel, Poses
from stages.shared.capture import Capture, Take
from stages.shared.capture.subject import open_subject_capture
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import in_order
from stages.shared.poses import load_poses
from stages.train.config import ALL_TAKES, TrainConfig
from stages.train.footage import Footage, joined
from stages.train.methods.base import MethodLayers
from stages.train.methods.registry import method_called
from stages.train.start import Start, read_start


@dataclass(frozen=True)
class Source:
    """Everything the stage reads.

    Attributes:
        footage: the takes; the registered one is the first. poses: row = frame number of the footage.
        pose_files: poses of the takes that were not registered.
    """

    registered: Artifact
    baked: Artifact
    capture: Capture
    footage: Footage
    poses: Poses
    start: Start
    pose_files: ExternalFiles | None = None

    @property
    def inputs(self) -> dict[str, Artifact | ExternalFiles]:
        groups = ("cameras", "images", "masks", "labels")
        files = {f"capture/{group}": self.capture.files(group, "train") for group in groups}
        inputs: dict[str, Artifact | ExternalFiles] = {
            "register-template": self.registered,
            "bake-maps": self.baked,
            **{name: ExternalFiles(name, self.capture.root, paths) for name, paths in files.items() if paths},
        }
        for given in (self.start.files, self.pose_files):
            if given is not None:
                inputs[given.name] = given
        return inputs

    def layers(self, method: str) -> MethodLayers:
        """What a method learns: maps of the layers that are there, or those it makes of them."""
        betas = load_poses(self.registered.file("smpl_params.npz")).betas
        found = method_called(method).layers(_baked_maps(self.baked), torch.from_numpy(betas))
        begun = {name: worn.maps for name, worn in self.start.layers.items()}
        return MethodLayers({**found.maps, **begun}, found.layer_ids)

    def own_maps(self, method: str) -> dict[str, dict[str, np.ndarray]]:
        """Arrays of the maps that this run has beside those of bake-maps, by layer."""
        if method_called(method).baked_layers:
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
    first = _training_take(capture, str(registered.summary.get("take")))
    others = [take for take in _other_takes(capture, config.takes) if take.name != first.name]
    poses = [load_poses(registered.file("smpl_params.npz"), body), *(take.poses for take in others)]
    footage, rows = joined([first, *others], poses, body)
    return Source(registered, baked, capture, footage, rows, start, _pose_files(workspace, capture, others))


def _training_take(capture: Capture, name: str) -> Take:
    takes = {take.name: take for take in capture.training_takes}
    if name not in takes:
        raise MissingInput(
            f"The capture has no training take called {name!r} any more.",
            str(capture.root),
            "Register the subject again with `gw register-template`.",
        )
    return takes[name]


def _other_takes(capture: Capture, names: tuple[str, ...]) -> list[Take]:
    """The takes to learn from beside the registered one, in the capture's order; `ALL_TAKES`: every one."""
    known = [take.name for take in capture.training_takes]
    for name in names:
        if name not in (*known, ALL_TAKES):
            held = name in (take.name for take in capture.test_takes)
            raise UsageProblem(
                f"The take {name!r} is held out for tests."
                if held
                else f"There is no training take {name!r}.",
                "option --take",
                "Choose of: " + ", ".join(known) + f"; or {ALL_TAKES}.",
            )
    found = [take for take in capture.training_takes if ALL_TAKES in names or take.name in names]
    for take in found:
        if not take.posed:
            raise MissingInput(
                f"The take {take.name} has no body poses.",
                str(capture.root),
                "Register the subject again with gw register-template --fit: it fits every take.",
            )
    return found


def _pose_files(workspace: Workspace, capture: Capture, others: list[Take]) -> ExternalFiles | None:
    """Where the poses of other takes come from: fitted at registration, or the capture's own."""
    if not others:
        return None
    if workspace.settings().get("fitted_poses"):
        folder = workspace.setting_path("fitted_poses")
        return ExternalFiles("fitted_poses/takes", folder, [folder / f"{take.name}.npz" for take in others])
    files = [path for take in others for path in take.pose_files]
    return ExternalFiles("capture/poses", capture.root, files) if files else None


def _baked_maps(baked: Artifact) -> dict[str, LayerMaps]:
    """Maps of the layers that are there, inner to outer."""
    return {name: LayerMaps.load(baked, name) for name in in_order(baked.summary["layers"])}
