"""What `gw train` reads: earlier stages, the capture, and another subject to start from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE
from stages.shared.artifacts import Artifact, ExternalFiles, Workspace
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import BodyModel, Poses
from stages.shared.capture import Capture, Take
from stages.shared.capture.exposure import Exposure, solve_exposures
from stages.shared.capture.subject import open_subject_capture
from stages.shared.capture.template_views import capture_files
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import in_order
from stages.shared.meshes.mesh import Mesh
from stages.shared.poses import load_poses
from stages.train.config import ALL_TAKES, TrainConfig
from stages.train.methods import Method, MethodLayers, method_called
from stages.train.take_sequence import TakeSequence, concatenate_takes
from stages.train.warm_start import WarmStart, read_warm_start


@dataclass(frozen=True)
class Source:
    """Everything the stage reads.

    Attributes:
        body: the registered body model. sequence: the takes; the registered one is the first.
        poses: row = frame number of the sequence. layers: what the method learns, with the maps of the layers
            that start from another subject. pose_files: poses of the takes that were not registered.
    """

    registered: Artifact
    baked: Artifact
    body: BodyModel
    capture: Capture
    sequence: TakeSequence
    poses: Poses
    method: Method
    layers: MethodLayers
    warm_start: WarmStart
    pose_files: ExternalFiles | None = None

    @property
    def inputs(self) -> dict[str, Artifact | ExternalFiles]:
        groups = ("cameras", "images", "masks", "labels")
        files = {group: self.capture.files(group, "train") for group in groups}
        inputs: dict[str, Artifact | ExternalFiles] = {
            "register-template": self.registered,
            "bake-maps": self.baked,
            **capture_files(self.capture, files),
        }
        for files_of in (self.warm_start.files, self.pose_files):
            if files_of is not None:
                inputs[files_of.name] = files_of
        return inputs

    @property
    def template_frame(self) -> int:
        """Number of the frame that the template was made from."""
        return int(self.registered.summary.get("frame", 0))

    def exposures(self, config: TrainConfig) -> dict[str, Exposure]:
        """What makes cameras differ from the others in the template's frame; empty with exposure "off"."""
        if config.exposure == "off":
            return {}
        template = self.registered.arrays("template")
        surface = Mesh(template["vertices"], template["faces"])
        return solve_exposures(self.sequence.takes[0], self.template_frame, surface)

    def maps_to_store(self) -> dict[str, dict[str, np.ndarray]]:
        """Arrays of the maps that differ from those of bake-maps, by layer."""
        if self.method.baked_layers:
            return {name: layer.maps.arrays() for name, layer in self.warm_start.layers.items()}
        arrays = {name: maps.arrays() for name, maps in self.layers.maps.items()}
        for name, ids in self.layers.layer_ids.items():
            arrays[name]["layer_ids"] = ids.numpy().astype(np.int32)
        return arrays


def open_source(workspace: Workspace, config: TrainConfig, from_subject: Path | None = None) -> Source:
    """What a run of `config` reads.

    Raises:
        MissingInput: an earlier stage has not run, or the capture has changed. Others: as `read_warm_start`.
    """
    registered, baked = workspace.require(REGISTER_TEMPLATE), workspace.require(BAKE_MAPS)
    body, baked_maps = BodyModel.from_arrays(registered.arrays("body.safetensors")), _baked_maps(baked)
    warm_start, method = WarmStart(), method_called(config.method)
    if from_subject is not None:
        warm_start = read_warm_start(from_subject, workspace, registered, baked_maps, config)
    capture = open_subject_capture(workspace, body)
    first = _training_take(capture, str(registered.summary.get("take")))
    others = [take for take in _other_takes(capture, config.takes) if take.name != first.name]
    poses = [load_poses(registered.file("smpl_params.npz"), body), *(take.poses for take in others)]
    sequence, rows = concatenate_takes([first, *others], poses, body)
    layers = method.layers(baked_maps, torch.from_numpy(poses[0].betas))
    pretrained = {name: layer.maps for name, layer in warm_start.layers.items()}
    layers = replace(layers, maps={**layers.maps, **pretrained})
    pose_files = _pose_files(workspace, capture, others)
    return Source(registered, baked, body, capture, sequence, rows, method, layers, warm_start, pose_files)


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
    """The takes to learn from besides the registered one, in the capture's order; `ALL_TAKES` is all."""
    known = [take.name for take in capture.training_takes]
    for name in names:
        if name not in (*known, ALL_TAKES):
            held_out = name in (take.name for take in capture.test_takes)
            raise UsageProblem(
                f"The take {name!r} is held out for tests."
                if held_out
                else f"There is no training take {name!r}.",
                "option --take",
                "Choose of: " + ", ".join(known) + f"; or {ALL_TAKES}.",
            )
    takes = [take for take in capture.training_takes if ALL_TAKES in names or take.name in names]
    for take in takes:
        if not take.posed:
            raise MissingInput(
                f"The take {take.name} has no body poses.",
                str(capture.root),
                "Register the subject again with gw register-template --fit: it fits every take.",
            )
    return takes


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
