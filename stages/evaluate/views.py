"""Which views are scored: novel poses from training cameras, novel views of training poses, and both."""

from __future__ import annotations

from dataclasses import dataclass

from stages.evaluate.config import EvaluateConfig
from stages.shared.capture import Capture, Take
from stages.shared.errors import MissingInput


@dataclass(frozen=True, eq=False)
class FrameViews:
    """The views of one frame.

    Attributes:
        take, frame: of the capture. cameras: names with an image. first: whether it is the first of its take,
            often the pose that was learned from.
    """

    take: Take
    frame: int
    cameras: tuple[str, ...]
    first: bool


def views_of(split: str, capture: Capture, training_take: str, config: EvaluateConfig) -> list[FrameViews]:
    """The frames of a split (one of SPLITS), in order; empty where the capture has none."""
    if split != "novel-view":
        frames = [
            _views(take, frame, _cameras(take, split, config), index == 0)
            for take in capture.test_takes
            for index, frame in enumerate(take.frames[:: config.test_frame_step])
        ]
    else:
        take = capture.take(training_take)
        frames = [
            _views(take, frame, _cameras(take, split, config), index == 0)
            for index, frame in enumerate(take.frames[:: config.frame_step])
        ]
    return [views for views in frames if views.cameras]


def require_views(views: list[FrameViews], split: str, capture: Capture) -> None:
    """Raise MissingInput where a split that was asked for has nothing to score."""
    if not views:
        lacking = {"novel-pose": "test take", "novel-view": "held-out camera"}.get(
            split, "test take seen by a held-out camera"
        )
        raise MissingInput(
            f"The capture has no {lacking}, so there is nothing to score for {split}.",
            str(capture.root),
            "Choose the other split with --split.",
        )


def _cameras(take: Take, split: str, config: EvaluateConfig) -> tuple[str, ...]:
    cameras = take.training_cameras if split == "novel-pose" else take.heldout_cameras
    return tuple(cameras[: config.cameras] if config.cameras else cameras)


def _views(take: Take, frame: int, cameras: tuple[str, ...], first: bool) -> FrameViews:
    return FrameViews(take, frame, tuple(name for name in cameras if take.has_image(name, frame)), first)


def views_by_split(
    capture: Capture, template_take: str, config: EvaluateConfig
) -> dict[str, list[FrameViews]]:
    """Views of every split asked for, by name ("novel_pose").

    The default asks for what the capture has: without a test take, or without a held-out camera, the other
    split is scored alone.

    Raises:
        MissingInput: a split that was asked for has no views, or none has by default.
    """
    every = {split: views_of(split, capture, template_take, config) for split in config.splits}
    by_default = config.splits == EvaluateConfig().splits and any(every.values())
    found = {}
    for split, views in every.items():
        if by_default and not views:
            continue
        require_views(views, split, capture)
        found[split.replace("-", "_")] = views
    return found
