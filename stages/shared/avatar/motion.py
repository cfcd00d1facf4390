"""How a body has moved of late, as numbers: what a pose alone does not say about hanging cloth.

Rates (root velocity and turning in the root's own frame, turning of the 21 body joints) fade into memories
with time constants of 0.1, 0.3, 0.9 … s: m ← m + (1 − e^(−dt/τ)) (rate − m). Beside them stands the direction
of up as the root sees it. A still pose, and the first of a sequence, has no motion: zeros. Times are in
seconds, so a pose file at another frame rate means the same.
"""

from __future__ import annotations

import math

import numpy as np
import roma
import torch
from torch import Tensor

from stages.shared.body import Poses

_JOINTS = 22  # root and body, without face and fingers
_FASTEST, _RATIO = 0.1, 3.0  # s, between time constants
_REMEMBERED = 5.0  # time constants
UP, RATES = 3, 3 + 3 * _JOINTS


def motion_length(memories: int) -> int:
    """Numbers that `recent_motion` answers."""
    return UP + memories * RATES if memories else 0


def time_constant(memory: int) -> float:
    """Seconds after which a memory has faded to 1/e."""
    return _FASTEST * _RATIO**memory


def recent_motion(poses: Poses, frame: int, memories: int) -> Tensor:
    """(3 + 69 K,) up direction, then K memories: root velocity (m/s), root turning, joint turning (rad/s).

    Arguments:
        poses: sequence; rows before `frame` are its past, as far as five of the longest time constants.
    """
    if not memories:
        return torch.zeros(0)
    first = max(0, frame - math.ceil(_REMEMBERED * time_constant(memories - 1) * poses.fps))
    turned = roma.rotvec_to_rotmat(torch.from_numpy(poses.rotations[first : frame + 1, :_JOINTS]).double())
    places = torch.from_numpy(poses.translation[first : frame + 1].astype(np.float64))
    root = turned[:, 0]
    up = root[-1].T @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    held = torch.zeros(memories, RATES, dtype=torch.float64)
    if len(places) > 1:
        velocity = ((places[1:] - places[:-1])[:, None] @ root[1:])[:, 0]
        turning = roma.rotmat_to_rotvec(turned[:-1].transpose(-1, -2) @ turned[1:])
        rates = torch.cat((velocity, turning.flatten(start_dim=1)), dim=1) * poses.fps
        for memory in range(memories):
            fading = math.exp(-1.0 / (poses.fps * time_constant(memory)))
            shares = (1 - fading) * fading ** torch.arange(len(rates) - 1, -1, -1, dtype=torch.float64)
            held[memory] = shares @ rates
    return torch.cat((up, held.flatten())).float()
