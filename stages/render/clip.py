"""A motion as bytes for a page that skins the Gaussians itself, read by clip.js.

Every Gaussian is carried in canonical space: what linear blend skinning with its four largest weights does
not explain stays as an offset per key frame, and pages blend linearly between key frames. So the key frames
are exact up to rounding, whatever moved the layer (bones, a decoder, a simulation).

"GSWC", u32 length of a JSON text, the text, then columns, each padded to 4 bytes, little-endian (N Gaussians,
T frames, K key frames): rest places (N,3) u16 over their range, covariances (N,6) f16 in units of `unit` m²,
colour and opacity (N,4) u8, joints (N,4) u8, weights (N,4) u8 that sum to 255, world_from_canonical of the
joints (T,55,12) f32 row by row, offsets (K,N,3) i8 in units of `offset_unit` m of the Gaussian's layer.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.avatar.pose import frame_pose
from stages.shared.body import Poses
from stages.shared.errors import UsageProblem
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit
from stages.shared.report import SILENT, Report
from stages.shared.splat.gaussians import Gaussians
from stages.shared.web.pack import UNIT, color_bytes, half_covariances, packed, quantised

MAGIC = 0x43575347
MOST_FRAMES = 3000
LARGEST_PAGE = 10_000_000  # bytes, with everything encoded
_WEIGHTS = 4
_TOLERANCE = 1e-3  # m between an interpolated place and the true one
_SAMPLES = 600_000  # places from which key frames are chosen
_CLIPPED = 0.9995  # share of offsets that are not clipped to eight bits
_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


def pack_clip(
    outfit: Outfit, poses: Poses, rows: Sequence[int], rate: float, report: Report = SILENT
) -> bytes:
    """The bytes of the frames `rows` of a motion, shown `rate` times a second.

    There are as many key frames as the motion needs, and no more than a page of 10 MB has room for.

    Raises UsageProblem: more than 3,000 frames.
    """
    if len(rows) > MOST_FRAMES:
        raise UsageProblem(
            f"The motion has {len(rows)} frames; a page plays at most {MOST_FRAMES}.",
            "option --frames",
            f"Choose some of them, as --frames 0:{MOST_FRAMES}.",
        )
    bones = _bones(outfit, poses, rows)
    joints, weights = _four_weights(np.concatenate([_skin_weights(layer.maps) for layer in outfit.layers]))
    skinned = _Skinned(CachedPoser(outfit), poses, rows, bones, joints, weights)
    keys = key_frames(skinned.sample(report), affordable_keys(len(rows), len(joints)))
    rest, offsets, covariances, tints = _canonical(skinned, keys, report)
    counts = [len(layer.maps) for layer in outfit.layers]
    starts = np.concatenate([[0], np.cumsum(counts)]).tolist()
    units, steps = [], np.empty(offsets.shape, np.int8)
    for start, end in itertools.pairwise(starts):
        part = offsets[:, start:end]
        unit = max(float(np.quantile(np.abs(part), _CLIPPED)), 1e-6) / 127
        steps[:, start:end] = np.clip(np.rint(part / unit), -127, 127)
        units.append(unit)
    places, ranges = zip(*(quantised(axis) for axis in rest.T), strict=True)
    layers = [
        {"name": name, "start": start, "count": count, "offset_unit": unit}
        for name, start, count, unit in zip(outfit.names, starts, counts, units, strict=False)
    ]
    info = {
        "count": len(rest), "frames": len(rows), "keys": keys, "rate": rate, "unit": UNIT,
        "joints": bones.shape[1], "layers": layers, "places": ranges,
    }  # fmt: skip
    upper = covariances[:, _UPPER[0], _UPPER[1]]
    columns = (
        np.column_stack(places),
        half_covariances(upper),
        color_bytes(tints),
        joints.astype(np.uint8),
        weights.astype(np.uint8),
        bones[:, :, :3].reshape(len(rows), -1).astype("<f4"),
        steps,
    )
    return packed(MAGIC, info, columns)


def affordable_keys(frames: int, gaussians: int) -> int:
    """Number of key frames with which a page stays below `LARGEST_PAGE`; at least two."""
    room = int(0.75 * LARGEST_PAGE) - 30 * gaussians - 2640 * frames - 60_000  # base64 takes a third more
    return max(2, room // max(1, 3 * gaussians))


def key_frames(places: Floats, most: int) -> list[int]:
    """Indices of the key frames: the ends, then again and again the frame that is interpolated worst.

    Ends when 99 % of the places are interpolated within a millimetre in every frame.

    Arguments:
        places: (T, M, 3) m, canonical places of some Gaussians in every frame. most: of key frames.
    """
    keys, errors = [0], np.zeros(len(places))
    if len(places) > 1:
        keys.append(len(places) - 1)
        errors[:] = _interpolation_errors(places, 0, len(places) - 1)
    while len(keys) < most and errors.max() > _TOLERANCE:
        worst = int(errors.argmax())
        keys = sorted([*keys, worst])
        at = keys.index(worst)
        for first, last in itertools.pairwise(keys[at - 1 : at + 2]):
            errors[first : last + 1] = _interpolation_errors(places, first, last)
    return keys


def _interpolation_errors(places: Floats, first: int, last: int) -> Doubles:
    """(last − first + 1,) m that 99 % of the places are off at most, interpolated between two frames."""
    shares = np.linspace(0, 1, last - first + 1, dtype=np.float32)[:, None, None]
    between = (1 - shares) * places[first] + shares * places[last]
    distances = np.linalg.norm(places[first : last + 1] - between, axis=2)
    return np.asarray(np.quantile(distances, 0.99, axis=1), np.float64)


@dataclass(frozen=True, eq=False)
class _Skinned:
    """A motion, and what takes its Gaussians back to canonical space.

    bones: (T, 55, 4, 4) world_from_canonical. joints, weights: (N, 4) as `_four_weights` makes them.
    """

    poser: CachedPoser
    poses: Poses
    rows: Sequence[int]
    bones: Doubles
    joints: NDArray[np.int64]
    weights: NDArray[np.int64]

    def canonical(self, frame: int, step: int = 1) -> tuple[Gaussians, Doubles, Doubles]:
        """Of every `step`-th Gaussian: all Gaussians in the world, canonical_from_world (3, 3), places."""
        gaussians = self.poser.composite(self.poses, self.rows[frame])
        matrices = blended(self.bones[frame], self.joints[::step], self.weights[::step])
        canonical_from_world: Doubles = np.asarray(np.linalg.inv(matrices[:, :, :3]), np.float64)
        moved = gaussians.means[::step].double().numpy() - matrices[:, :, 3]
        return gaussians, canonical_from_world, np.einsum("nij,nj->ni", canonical_from_world, moved)

    def sample(self, report: Report) -> Floats:
        """(T, M, 3) m canonical places of some Gaussians in all frames."""
        step = max(1, len(self.joints) * len(self.rows) // _SAMPLES)
        places = []
        for frame in range(len(self.rows)):
            places.append(self.canonical(frame, step)[2].astype(np.float32))
            report.progress(frame + 1, len(self.rows))
        return np.stack(places)


def _canonical(
    skinned: _Skinned, keys: Sequence[int], report: Report
) -> tuple[Doubles, Doubles, Doubles, Doubles]:
    """Rest places (N, 3) m, offsets (K, N, 3) m, covariances (N, 3, 3) m², colours and opacities (N, 4)."""
    count = len(skinned.joints)
    places = np.empty((len(keys), count, 3))
    covariances, tints = np.zeros((count, 3, 3)), np.zeros((count, 4))
    for index, key in enumerate(keys):
        gaussians, canonical_from_world, places[index] = skinned.canonical(key)
        world = gaussians.covariances.double().numpy()
        covariances += canonical_from_world @ world @ canonical_from_world.transpose(0, 2, 1) / len(keys)
        colors = gaussians.features[:, :3].numpy(), gaussians.opacities.numpy()
        tints += np.column_stack(colors) / len(keys)
        report.progress(index + 1, len(keys))
    rest = places.mean(axis=0)
    return rest, places - rest, covariances, tints


def blended(bones: Doubles, joints: NDArray[np.int64], weights: NDArray[np.int64]) -> Doubles:
    """(N, 3, 4) world_from_canonical of every Gaussian, as the page blends it from bones (J, 4, 4)."""
    return np.einsum("nk,nkij->nij", weights / 255.0, bones[joints][:, :, :3])


def _bones(outfit: Outfit, poses: Poses, rows: Sequence[int]) -> Doubles:
    """(T, 55, 4, 4) world_from_canonical of the joints, in the precision in which they are written."""
    arrays = (poses.rotations[list(rows)], poses.translation[list(rows)], outfit.betas)
    pose = frame_pose(outfit.body_model, *(torch.from_numpy(array) for array in arrays))
    return pose.transforms.float().double().numpy()


def _skin_weights(maps: object) -> Doubles:
    return np.asarray(maps.skin_weights.double().numpy())  # type: ignore[attr-defined]


def _four_weights(weights: Doubles) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Joints (N, 4) and weights (N, 4) that sum to 255: the largest ones, rounded without losing any."""
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :_WEIGHTS]
    largest = np.take_along_axis(weights, joints, axis=1)
    steps = np.rint(255 * largest / largest.sum(axis=1, keepdims=True)).astype(np.int64)
    steps[:, 0] += 255 - steps.sum(axis=1)
    return joints, steps
