"""Methods that render a frame for a camera: the trained layers, and the baseline of meshes."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.baseline import Baseline
from stages.evaluate.views import FrameViews
from stages.shared.avatar.deform import PosedGaussians
from stages.shared.capture import Take
from stages.shared.capture.camera import Camera
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.render_image import render_image

Rendered = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]  # picture on black, alpha, labels


class Method(Protocol):
    """Something that can show a frame to a camera."""

    def pose(self, views: FrameViews) -> None: ...

    def render(self, camera: Camera) -> Rendered: ...


class TrainedMethod:
    """The trained layers of the subject, as learned in training takes and driven in others.

    Arguments:
        outfit: the subject in its own clothes. drive: as `Outfit.driven` takes it.
    """

    def __init__(self, outfit: Outfit, drive: str = "learned") -> None:
        self.outfit = outfit
        self._by_split = {"train": outfit.driven(drive, trained_poses=True), "test": outfit.driven(drive)}

    def pose(self, views: FrameViews) -> None:
        outfit = self._by_split[views.take.split]
        self._composite = outfit.composite(views.take.poses, views.frame)

    def posed(self, take: Take, frame: int) -> dict[str, PosedGaussians]:
        """All layers in a frame of a take."""
        return self._by_split[take.split].posed(take.poses, frame)

    def render(self, camera: Camera) -> Rendered:
        shot = render_image(self._composite, camera)
        return shot.on((0.0, 0.0, 0.0)), shot.alpha, shot.labels


class BaselineMethod:
    """The meshes that learned nothing."""

    def __init__(self, baseline: Baseline, supersampling: int) -> None:
        self.baseline, self.supersampling = baseline, supersampling

    def pose(self, views: FrameViews) -> None:
        self._scene = self.baseline.posed(views.take.poses, views.frame)

    def render(self, camera: Camera) -> Rendered:
        return self.baseline.render(self._scene, camera, self.supersampling)
