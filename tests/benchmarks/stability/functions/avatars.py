"""What a pose means to a layer: anchors, blendshapes, memories of motion, the projection of strange poses;
and from there to a picture: activations, shape transfer, push-out, motions at another frame rate."""

from __future__ import annotations

import copy
import math
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy import sparse

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.blendshapes import PoseCoefficients
from stages.shared.avatar.decoders.key_poses import KeyPoseOffsets
from stages.shared.avatar.decoders.pose_prior import PosePrior
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.deform import Attributes, pose_layer, shaped_positions
from stages.shared.avatar.pose import RATES, UP, motion_scale, recent_motion, time_constant
from stages.shared.body import Poses
from stages.shared.outfit.collision_correction import smooth_field
from stages.shared.poses.convert import resample
from stages.shared.splat.api import rasterize
from tests.benchmarks.stability.function import Function, Inputs, unit
from tests.benchmarks.stability.functions.sheet import SIDE, sheet

_FEATURES, _ANCHORS, _MEMORIES = 40, 6, 3
_JOINTS = 22
_PAST, _FPS = 12, 30.0
_REMEMBERED = 5.0  # of the longest time constants
_PIXELS = 16
_SIZES = (0.0, 1e-30, 1e-12, 1e-3, 1.0, 10.0, 1e3, 1e6, 1e18, 1e30)


@cache
def _known_poses() -> torch.Tensor:
    """Descriptions of poses (K, M) that lie near one another."""
    random = np.random.default_rng(1)
    spread = np.linspace(1.0, 0.1, _FEATURES)
    return torch.from_numpy(random.normal(size=(_ANCHORS * 4, _FEATURES)) * spread)


def _strange(distance: float, random: np.random.Generator) -> Inputs:
    """A pose so far from the first known one."""
    return {"pose": _known_poses()[0].numpy() + distance * unit(random, 1, _FEATURES)[0]}


@cache
def _prior() -> PosePrior:
    prior = PosePrior(8, _FEATURES, 2.0)
    prior.fit(_known_poses().float())
    return prior


@cache
def _anchors() -> KeyPoseOffsets:
    anchors = KeyPoseOffsets(_ANCHORS, (3, 4), _FEATURES, own_widths=True)
    anchors.fit(_known_poses().float())
    with torch.no_grad():
        anchors.offsets.copy_(0.02 * torch.randn(anchors.offsets.shape, generator=_generator()))
    return anchors.requires_grad_(False)


@cache
def _coefficients() -> PoseCoefficients:
    found = PoseCoefficients(_ANCHORS, 5, _MEMORIES)
    random = _generator()
    found.centres.copy_(found.describe(torch.eye(4).repeat(55, 1, 1), None))
    found.centres += 0.1 * torch.randn(found.centres.shape, generator=random)
    found.weights.copy_(torch.randn(found.weights.shape, generator=random))
    found.bandwidth.fill_(2.0)
    return found


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def _as(module: Any, dtype: torch.dtype) -> Any:
    """The module with these very numbers in another precision."""
    return copy.deepcopy(module).to(dtype)


def _moving(size: float, random: np.random.Generator) -> Inputs:
    return {"motion": size * random.uniform(-1, 1, UP + _MEMORIES * RATES)}


def _coefficients_of(a: dict[str, Any]) -> torch.Tensor:
    still = torch.eye(4, dtype=a["motion"].dtype).repeat(55, 1, 1)
    found: torch.Tensor = _as(_coefficients(), a["motion"].dtype)(still, a["motion"])
    return found


def _turning(step: float, random: np.random.Generator) -> Inputs:
    """Body joints that turn by `step` rad a frame about axes of their own, and a root that walks."""
    times = np.arange(_PAST + 1)
    rotations = np.zeros((len(times), 55, 3))
    rotations[:, 1:_JOINTS] = times[:, None, None] * step * unit(random, _JOINTS - 1)
    return {"rotations": rotations, "translation": 0.03 * times[:, None] * unit(random, 1)}


def _at_rate(fps: float, random: np.random.Generator) -> Inputs:
    return {**_turning(0.01, random), "fps": np.array(fps)}


def _film(a: dict[str, Any], fps: float) -> Poses:
    return Poses(a["rotations"], a["translation"], np.zeros(10), np.zeros((_PAST + 1, 10)), fps)  # type: ignore[arg-type]


def _memories(a: dict[str, Any]) -> np.ndarray:
    poses = _film(a, float(a.get("fps", _FPS)))
    return recent_motion(poses, _PAST, _MEMORIES).double().numpy()


def _memories_in_closed_form(a: dict[str, Any]) -> np.ndarray:
    """m = (1 − e^(−n dt/τ)) rate after n frames of one rate that are remembered; up is (0, 1, 0)."""
    fps = float(a.get("fps", _FPS))
    a_frame = (a["translation"][-1], np.zeros(3), a["rotations"][-1, 1:_JOINTS].ravel())
    rates = np.concatenate(a_frame) / _PAST * fps
    frames = min(_PAST, math.ceil(_REMEMBERED * time_constant(_MEMORIES - 1) * fps))
    held = [1 - math.exp(-frames / (fps * time_constant(memory))) for memory in range(_MEMORIES)]
    return np.concatenate([[0.0, 1.0, 0.0], *(share * rates for share in held)])


def _resampled(a: dict[str, Any]) -> np.ndarray:
    """Of the new frames the last: rotations of the body joints, and the root's place."""
    found = resample(_film(a, _FPS), float(a["fps"]))
    return np.concatenate([found.rotations[-1, 1:_JOINTS], found.translation[-1:]]).astype(np.float64)


def _resampled_in_closed_form(a: dict[str, Any]) -> np.ndarray:
    share = math.floor(_PAST / _FPS * float(a["fps"]) + 1e-6) / float(a["fps"]) * _FPS / _PAST
    return np.asarray(share * np.concatenate([a["rotations"][-1, 1:_JOINTS], a["translation"][-1:]]))


def _rates_of_moments(size: float, random: np.random.Generator) -> Inputs:
    return {"motions": size * random.normal(size=(9, UP + _MEMORIES * RATES))}


def _betas(size: float, random: np.random.Generator) -> Inputs:
    return {"betas": size * random.uniform(-1, 1, 10)}


@cache
def _model(dtype: torch.dtype) -> StyleUNetDecoder:
    """A layer without networks; decoded as trained layers are."""
    config = ModelConfig(networks="none")
    model = StyleUNetDecoder(sheet(), config).requires_grad_(False)
    found: StyleUNetDecoder = _as(model, dtype)
    return found


def _residuals(size: float, random: np.random.Generator) -> Inputs:
    return {"residual": size * random.uniform(-1, 1, (SIDE * SIDE, 14))}


def _posed(a: dict[str, Any]) -> tuple[Attributes, Any]:
    dtype = a["residual"].dtype
    attributes = _model(dtype).attributes(a["residual"])
    still = torch.eye(4, dtype=dtype).repeat(55, 1, 1)
    return attributes, pose_layer(sheet(dtype), attributes, still, torch.zeros(10, dtype=dtype))


def _decoded(a: dict[str, Any]) -> torch.Tensor:
    """From a decoder's numbers to a picture."""
    dtype = a["residual"].dtype
    _, posed = _posed(a)
    view = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=dtype))
    view[2, 3] = 1.0
    lens = torch.tensor([[32.0, 0, 8], [0, 32, 8], [0, 0, 1]], dtype=dtype)
    picture = rasterize(
        posed.means, None, None, posed.opacities, posed.colors, view, lens, _PIXELS, _PIXELS,
        covars=posed.covariances, backend="reference",
    )  # fmt: skip
    return torch.cat([picture.features, picture.alpha[..., None]], dim=-1)


@cache
def _links() -> sparse.csr_matrix:
    """Means over the neighbours of the sheet's texels."""
    neighbours = sheet().neighbours.numpy()
    start, side = np.nonzero(neighbours >= 0)
    degree = np.bincount(start).astype(np.float32)
    count = len(neighbours)
    return sparse.csr_matrix((1 / degree[start], (start, neighbours[start, side])), shape=(count, count))


def _needs(metres: float, random: np.random.Generator) -> Inputs:
    asking = random.random(SIDE * SIDE) > 0.7
    return {"need": np.where(asking, metres, -1.0), "along": unit(random, SIDE * SIDE)}


AVATARS = (
    Function(
        "PosePrior", "pose models", "distance from a known pose", _SIZES, _strange,
        lambda a: _as(_prior(), a["pose"].dtype)(a["pose"]), everyday=(0.0, 1e3), tolerance=1e-5,
    ),
    Function(
        "KeyPoseOffsets", "pose models", "distance from a known pose", _SIZES, _strange,
        lambda a: _as(_anchors(), a["pose"].dtype)(a["pose"]), everyday=(0.0, 1.0), tolerance=1e-4,
        gradients=("pose",), gradient_tolerance=1e-3,
    ),
    Function(
        "PoseCoefficients", "pose models", "recent motion, m/s and rad/s", _SIZES, _moving,
        _coefficients_of, everyday=(0.0, 1.0), tolerance=1e-4,
    ),
    Function(
        "recent_motion", "pose models", "turning of every joint, rad a frame",
        (0.0, 1e-30, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 3.0, math.pi - 1e-6), _turning, _memories,
        everyday=(0.0, 1.0), tolerance=1e-5, numpy=True, truth=_memories_in_closed_form, single=True,
    ),
    Function(
        "recent_motion", "pose models", "frames a second",
        (1e-3, 1.0, 24.0, 120.0, 1e4, 1e6), _at_rate, _memories, everyday=(1e-3, 1e6),
        tolerance=1e-5, numpy=True, truth=_memories_in_closed_form, single=True,
    ),
    Function(
        "motion_scale", "pose models", "recent motion, m/s and rad/s", _SIZES, _rates_of_moments,
        lambda a: motion_scale(a["motions"], 1.0, 0.05)[UP:], everyday=(0.0, 1e6), tolerance=1e-5,
    ),
    Function(
        "resample", "pose models", "new frames a second", (3.0, 7.0, 24.0, 60.0, 1e3, 5e4), _at_rate,
        _resampled, everyday=(3.0, 5e4), tolerance=1e-5, numpy=True, single=True,
        truth=_resampled_in_closed_form,
    ),
    Function(
        "shaped_positions", "shapes", "size of β", (0.0, 1e-6, 1.0, 10.0, 1e3, 1e20, 1e38), _betas,
        lambda a: shaped_positions(sheet(a["betas"].dtype), a["betas"]), everyday=(0.0, 1e3),
        tolerance=2e-6, gradients=("betas",), bfloat16=True,
    ),
    Function(
        "decoder to picture", "pose models", "residual of a decoder", _SIZES, _residuals, _decoded,
        everyday=(0.0, 1.0), tolerance=5e-3, gradients=("residual",), gradient_tolerance=5e-2,
    ),
    Function(
        "smooth_field", "try-on", "push, m", _SIZES, _needs,
        lambda a: smooth_field(_links(), a["need"], a["along"]), everyday=(1e-12, 1e3), tolerance=1e-5,
        numpy=True,
    ),
)  # fmt: skip
