"""A take whose pictures are reduced to the detail that its use can show: large pictures cost little then.

Geometry and first colours are looked up at points some millimetres apart. Where a picture has many pixels
between two points, the extra pixels add cost and noise and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera
from stages.shared.capture.images import JPEG_STEPS, check_size, read_image
from stages.shared.capture.take import Take
from stages.shared.layers import LABEL_IDS, NO_LABEL

Picture = NDArray[np.uint8]

_PIXELS_PER_TEXEL = 2.5
_ENOUGH_PIXELS = 512  # along the long side: pictures of this size are never reduced
_WORTH_IT = 0.8  # a reduction by less is left out
_CACHE_BYTES = 128 << 20


def texel_scale(camera: Camera, centre: NDArray[np.floating], texel: float) -> float:
    """Factor, at most 1, at which a camera's pictures show a texel with two to three pixels.

    Pictures of up to 512 pixels keep their size.

    Arguments:
        centre: (3,) middle of the person, world, metres. texel: distance of neighbouring points, metres.
    """
    depth = float(camera.camera_from_world[2, :3] @ centre + camera.camera_from_world[2, 3])
    pixels = float(camera.intrinsics[0, 0]) * texel / max(depth, 1e-3)
    scale = max(_PIXELS_PER_TEXEL / max(pixels, 1e-9), _ENOUGH_PIXELS / max(camera.width, camera.height))
    return round(scale, 3) if scale < _WORTH_IT else 1.0


def scaled_for_texels(take: Take, centre: NDArray[np.floating], texel: float, scale: float = 0.0) -> Take:
    """The take with pictures, masks and labels reduced for points `texel` metres apart (`texel_scale`).

    Arguments:
        centre: (3,) middle of the person, world, metres.
        scale: factor for all cameras instead, 1 for full size; 0 lets `texel_scale` choose for each camera.
    """
    cameras = take.cameras.items()
    return _scaled(take, {name: scale or texel_scale(camera, centre, texel) for name, camera in cameras})


def reduced_to(take: Take, long_side: int) -> Take:
    """The take with pictures, masks and labels of at most `long_side` pixels."""
    cameras = take.cameras.items()
    return _scaled(take, {n: min(1.0, long_side / max(one.width, one.height)) for n, one in cameras})


def _scaled(take: Take, scales: dict[str, float]) -> Take:
    if all(factor == 1.0 for factor in scales.values()):
        return take
    values = {part.name: getattr(take, part.name) for part in fields(Take)}
    values["cameras"] = {name: camera.scaled(scales[name]) for name, camera in take.cameras.items()}
    return ScaledTake(**values, original=take.original if isinstance(take, ScaledTake) else take)


def picture_scales(take: Take | None) -> list[float]:
    """Smallest and largest factor by which the pictures of a take are reduced; [1, 1] without reduction."""
    if not isinstance(take, ScaledTake):
        return [1.0, 1.0]
    factors = [take.cameras[name].width / take.original.cameras[name].width for name in take.cameras]
    return [round(min(factors), 3), round(max(factors), 3)]


@dataclass(frozen=True, eq=False)
class ScaledTake(Take):
    """A take with reduced pictures; made by `scaled_for_texels`. The first 128 MiB of them stay in memory.

    Attributes:
        original: the take as it was captured.
    """

    original: Take = field(kw_only=True)
    _cache: dict[tuple[str, str, int], Picture | None] = field(default_factory=dict, init=False)

    def image(self, camera: str | Camera, frame: int) -> Picture:
        """(h, w, 3) u8 sRGB; a JPEG is decoded at the next larger size that the format offers."""
        picture = self._remembered("image", camera, frame)
        assert picture is not None
        return picture

    def mask(self, camera: str | Camera, frame: int) -> Picture:
        """(h, w) u8, coverage by the person, 0 to 255."""
        picture = self._remembered("mask", camera, frame)
        assert picture is not None
        return picture

    def labels(self, camera: str | Camera, frame: int) -> Picture | None:
        """(h, w) u8 label ids: the one that most of the pixels behind each pixel have; None as in `Take`."""
        return self._remembered("labels", camera, frame)

    def _remembered(self, kind: str, camera: str | Camera, frame: int) -> Picture | None:
        name = self.camera(camera).name
        key = (kind, name, frame)
        if key not in self._cache:
            picture = self._reduced(kind, name, frame)
            known = sum(one.nbytes for one in self._cache.values() if one is not None)
            if picture is None or known + picture.nbytes > _CACHE_BYTES:
                return picture
            self._cache[key] = picture
        return self._cache[key]

    def _reduced(self, kind: str, name: str, frame: int) -> Picture | None:
        small, full = self.cameras[name], self.original.cameras[name]
        size = (small.width, small.height)
        if kind == "image":
            path = self.view(name, frame).image
            step = max(step for step in JPEG_STEPS if step * max(size) <= max(full.width, full.height))
            picture = check_size(
                read_image(path, step), -(-full.width // step), -(-full.height // step), path
            )
            return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        if kind == "mask":
            mask = self.original.mask(name, frame)
            return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_AREA), np.uint8)
        ids = self.original.labels(name, frame)
        return None if ids is None else commonest_ids(ids, size)


def commonest_ids(ids: Picture, size: tuple[int, int]) -> Picture:
    """Label ids (H, W) u8 reduced to `size` (width, height): the id that covers most of each pixel."""
    present = [value for value in (NO_LABEL, *LABEL_IDS) if (ids == value).any()]
    shares = [
        cv2.resize(255 * (ids == v).astype(np.uint8), size, interpolation=cv2.INTER_AREA) for v in present
    ]
    return np.array(present, np.uint8)[np.argmax(shares, axis=0)]
