"""What changes in the course of a run: learning rates, picture size, the second stage.

Every function takes the progress of the run, 0 at the start and 1 at the end.
"""

from __future__ import annotations

import math

from stages.train.config import LossWeights, TrainConfig

_COARSE_STEPS = 3


def progress(config: TrainConfig, step: int, elapsed: float) -> float:
    """How far the run is, 0..1: by steps, or by the clock (`elapsed` s) when that is nearer to its end."""
    done = step / max(config.steps, 1)
    if config.minutes > 0:
        done = max(done, elapsed / (60.0 * config.minutes))
    return min(done, 1.0)


def rate_factor(config: TrainConfig, done: float) -> float:
    """Cosine from 1 to `rate_end`."""
    return config.rate_end + (1.0 - config.rate_end) * 0.5 * (1.0 + math.cos(math.pi * done))


def image_scale(config: TrainConfig, done: float) -> float:
    """Size of the pictures: grows in a few steps from coarse to full within `coarse_until`."""
    if config.coarse_until <= 0 or done >= config.coarse_until:
        return config.image_scale
    share = math.floor(_COARSE_STEPS * done / config.coarse_until) / _COARSE_STEPS
    return config.image_scale * (config.coarse_scale + (1.0 - config.coarse_scale) * share)


def stage_weights(config: TrainConfig, done: float) -> LossWeights:
    """The weights in force: the first stage knows neither penetration nor smoothing (paper, sec. 3.4)."""
    if done >= config.stage_two:
        return config.weights
    values = {name: getattr(config.weights, name) for name in config.weights.__dataclass_fields__}
    return LossWeights(**{**values, "penetration": 0.0, "smooth": 0.0})
