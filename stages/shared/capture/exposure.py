"""Colour gain and offset of each camera: exposure and white balance differ between cameras.

A camera shows gain * colour + offset of a surface, for each of red, green and blue in sRGB (0..1). Points of
the template that several cameras see give both. The colours that are learned are those of the median camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.projection import sample_bilinear, visibility
from stages.shared.capture.take import Take
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import vertex_normals

Doubles = NDArray[np.float64]

_MOST_POINTS = 6000
_FEWEST_CAMERAS, _FEWEST_VIEWS, _FEWEST_SHARED = 3, 2, 100  # of a take; of a point; such points of a camera
_LEAST_COSINE, _LEAST_MASK = 0.4, 0.95
_ROUNDS, _ROBUST_ROUNDS = 20, 4
_ROBUST = 0.04  # difference of colours that halves a point's weight
_GAIN_PULL, _OFFSET_PULL = 5e-4, 5e-3  # towards 1 and 0, per point
_ALIKE = 0.03  # a camera that changes no colour by more than this is left as it is


@dataclass(frozen=True)
class Exposure:
    """What one camera does to colours: gain and offset, each (red, green, blue), sRGB 0..1."""

    gain: tuple[float, float, float]
    offset: tuple[float, float, float]

    def removed(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture (…, 3) u8 of this camera in the colours that all cameras share."""
        return _bytes((picture / 255.0 - self.offset) / self.gain)

    def applied(self, picture: NDArray[np.uint8], alpha: NDArray[np.floating]) -> NDArray[np.uint8]:
        """A picture (H, W, 3) u8 on black with its alpha (H, W), as this camera would show it."""
        return _bytes(picture / 255.0 * self.gain + alpha[..., None] * np.array(self.offset))


def solve_exposures(take: Take, frame: int, surface: Mesh) -> dict[str, Exposure]:
    """Exposures of the training cameras that differ from the others; empty where all are alike.

    Arguments:
        surface: the dressed person in that frame, world, metres.
    """
    names = [name for name in take.training_cameras if take.has_image(name, frame)]
    if len(names) < _FEWEST_CAMERAS:
        return {}
    seen = np.stack([_colors(take, name, frame, surface) for name in names])
    seen = seen[:, np.isfinite(seen[..., 0]).sum(axis=0) >= _FEWEST_VIEWS]
    gains, offsets = np.ones((len(names), 3)), np.zeros((len(names), 3))
    usable = np.flatnonzero(np.isfinite(seen[..., 0]).sum(axis=1) >= _FEWEST_SHARED)
    for _ in range(_ROUNDS if len(usable) >= _FEWEST_CAMERAS else 0):
        common = np.nanmedian((seen - offsets[:, None]) / gains[:, None], axis=0)
        for row in usable:
            rows = np.isfinite(seen[row, :, 0])
            for channel in range(3):
                fit = _line(common[rows, channel], seen[row, rows, channel])
                gains[row, channel], offsets[row, channel] = fit
        # A gain and an offset that all cameras share are part of the colours.
        gains[usable] /= np.median(gains[usable], axis=0)
        offsets[usable] -= np.median(offsets[usable], axis=0)
    return {
        names[row]: Exposure(_three(gains[row]), _three(offsets[row]))
        for row in usable
        if np.abs(gains[row] * 0.5 + offsets[row] - 0.5).max() > _ALIKE / 2
    }


def exposures_json(exposures: Mapping[str, Exposure]) -> dict[str, object]:
    """Exposures by camera, for a JSON file."""
    return {name: {"gain": list(one.gain), "offset": list(one.offset)} for name, one in exposures.items()}


def read_exposures(content: object, where: str) -> dict[str, Exposure]:
    """What `exposures_json` wrote.

    Raises:
        BadData: something else, or numbers that no camera has.
    """
    try:
        assert isinstance(content, dict)
        found = {
            str(name): Exposure(_three(np.array(one["gain"])), _three(np.array(one["offset"])))
            for name, one in content.items()
        }
        assert all(
            min(one.gain) > 0 and np.isfinite([*one.gain, *one.offset]).all() for one in found.values()
        )
    except (AssertionError, KeyError, TypeError, ValueError):
        raise BadData("These are no exposures of cameras.", where, "Train again.") from None
    return found


def _colors(take: Take, name: str, frame: int, surface: Mesh) -> Doubles:
    """(P, 3) sRGB 0..1 of some vertices in one picture; NaN where they are hidden or seen at a flat angle."""
    step = max(1, len(surface.vertices) // _MOST_POINTS)
    points = surface.vertices[::step].astype(np.float64)
    normals = vertex_normals(surface.vertices, surface.faces)[::step]
    sight = visibility(points, normals, take.camera(name), RayScene(surface.vertices, surface.faces))
    rows = np.flatnonzero(sight.visible & (sight.cosine > _LEAST_COSINE))
    picture = np.dstack([take.image(name, frame), take.mask(name, frame)]).astype(np.float32) / np.float32(
        255
    )
    samples = sample_bilinear(picture, sight.pixels[rows])
    rows, samples = rows[samples[:, 3] > _LEAST_MASK], samples[samples[:, 3] > _LEAST_MASK]
    colors = np.full((len(points), 3), np.nan)
    colors[rows] = samples[:, :3]
    return colors


def _line(common: Doubles, seen: Doubles) -> Doubles:
    """Gain and offset (2,) with seen ≈ gain * common + offset, robust, pulled towards 1 and 0."""
    columns = np.stack([common, np.ones_like(common)], axis=1)
    pull, weights = len(common) * np.array([_GAIN_PULL, _OFFSET_PULL]), np.ones_like(common)
    for _ in range(_ROBUST_ROUNDS):
        weighted = columns * weights[:, None]
        right = weighted.T @ seen + pull * (1.0, 0.0)
        line = np.linalg.solve(weighted.T @ columns + np.diag(pull), right)
        weights = 1 / (1 + ((seen - columns @ line) / _ROBUST) ** 2)
    return np.asarray(line, np.float64)


def _three(values: NDArray[np.floating]) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
