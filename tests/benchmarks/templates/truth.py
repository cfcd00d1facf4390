"""Comparisons with what is known: given body parameters, labels of the scan, shapes put on and off again."""

from __future__ import annotations

import numpy as np
import torch

from stages.shared.artifacts import Artifact
from stages.shared.body.kinematics import posed_joints, shaped_vertices
from stages.shared.body.model import BodyModel
from stages.shared.body.posed import pose_tensors
from stages.shared.body.poses import Poses
from stages.shared.layers import LAYER_OF_LABEL, NO_LABEL
from stages.shared.metrics.picture import iou

_BODY_JOINTS = 22  # without face and fingers


def fit_errors(body: BodyModel, fitted: Poses, given: Poses, frame: int) -> tuple[float, float]:
    """Mean distance of the 22 body joints at a frame, and mean distance of the unposed vertices; metres.

    `fitted` has one row, `given` the take's.
    """
    joints = [
        posed_joints(body, *pose_tensors(poses, row, dtype=torch.float64)).numpy()
        for poses, row in ((fitted, 0), (given, frame))
    ]
    shapes = [shaped_vertices(body, _double(poses.betas)).numpy() for poses in (fitted, given)]
    # Shapes are compared centred: where the body stands is the translation's business.
    shapes = [shape - shape.mean(axis=0) for shape in shapes]
    joint_error = np.linalg.norm(joints[0][:_BODY_JOINTS] - joints[1][:_BODY_JOINTS], axis=1).mean()
    return float(joint_error), float(np.linalg.norm(shapes[0] - shapes[1], axis=1).mean())


def label_scores(found: np.ndarray, truth: np.ndarray) -> dict[str, float | None]:
    """Share of right vertex labels, and mean IoU over the layers that the truth shows; both (V,) ids."""
    known = truth != NO_LABEL
    if not known.any():
        return {"accuracy": None, "miou": None}
    found, truth = found[known], truth[known]
    names = {name for label, name in LAYER_OF_LABEL.items() if (truth == label).any()}
    overlaps = []
    for name in sorted(names):
        labels = [label for label, layer in LAYER_OF_LABEL.items() if layer == name]
        overlaps.append(iou(np.isin(found, labels), np.isin(truth, labels)))
    present = [overlap for overlap in overlaps if overlap is not None]
    return {"accuracy": float((found == truth).mean()), "miou": float(np.mean(present))}


def shape_round_trip(segmented: Artifact, layer: str, betas: np.ndarray) -> float:
    """Largest distance, metres, between a layer and itself after another shape is put on and off again.

    Everything is stored in single precision in between, as files are.
    """
    mesh = segmented.arrays(layer)
    move = np.einsum("vbk,b->vk", mesh["shape_directions"], np.asarray(betas, np.float32))
    worn = (mesh["vertices"] + move).astype(np.float32)
    back = (worn - move).astype(np.float32)
    return float(np.linalg.norm(back - mesh["vertices"], axis=1).max(initial=0.0))


def _double(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float64)
