"""How much of the capture a run will look at; known before it starts."""

from __future__ import annotations

from dataclasses import dataclass

from stages.train import cost
from stages.train.config import TrainConfig
from stages.train.footage import Footage

_SAMPLES = 6


@dataclass(frozen=True)
class Extent:
    """Numbers of what is read.

    Attributes:
        learned, followed: frames that are learned from, and that garments are followed through.
        read: frames of either kind. cameras: of each. pixels: of a picture cropped to the subject, the mean
            of a few.
    """

    learned: int
    followed: int
    read: int
    cameras: int
    pixels: int

    @property
    def tracked_views(self) -> int:
        """Pictures through which garments are followed."""
        return self.followed * self.cameras


def extent_of(footage: Footage, config: TrainConfig) -> Extent:
    """What a run with this (resolved) configuration looks at. Raises BadData for an empty mask."""
    cameras = footage.training_cameras
    config = cost.affordable_tracking(config, len(footage.frames), len(cameras))
    learned = footage.every(config.frame_step)
    followed = footage.every(config.track.frame_step) if config.track.frame_step else []
    views = [(camera, frame) for frame in learned for camera in cameras]
    boxes = [footage.subject_box(*view, margin=8) for view in views[:: max(1, len(views) // _SAMPLES)]]
    sizes = [(right - left) * (bottom - top) for left, top, right, bottom in boxes]
    mean = round(sum(sizes) / max(len(sizes), 1))
    return Extent(len(learned), len(followed), len({*learned, *followed}), len(cameras), mean)
