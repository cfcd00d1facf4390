"""One person in a picture: where (detector), 33 landmarks and a soft mask (landmark network).

The networks are BlazePose's (V. Bazarevsky et al., BlazePose: on-device real-time body pose tracking, 2020).
The detector looks at the whole picture, the landmark network at a square around the person that is turned so
that the person stands upright.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.vision.models import DETECTOR, LANDMARKS, model_bytes
from stages.shared.vision.network import Network, Singles

Doubles = NDArray[np.float64]
_Image = NDArray[np.uint8]

LANDMARK_COUNT = 33
_STRIDES = ((8, 2), (16, 2), (32, 6))  # anchors a cell of each feature map
_BOX_VALUES = 12
_MIDDLE, _TOP = 4, 6  # where a detection holds the middle of the hips and the end of the body's circle
_LEAST_SCORE, _LEAST_PRESENCE = 0.5, 0.5
_MARGIN = 1.25  # side of the square against twice the body's circle
_VALUES, _ALL_LANDMARKS = 5, 39  # x y z visibility presence of 33 landmarks and 6 more
_CIRCLE = (33, 34)  # of these, middle and end of the body's circle
_HEATMAP_REACH, _LEAST_HEAT = 3, 0.5


@dataclass(frozen=True, eq=False)
class Person:
    """What the networks say about one picture.

    Attributes:
        pixels: (33, 2) f64 landmarks, pixel centres at integer + 0.5, BlazePose's order.
        visibility: (33,) f64 in [0, 1].
        mask: (H, W) u8 coverage, 0 to 255, soft; 0 outside of the square that the network saw.
        square: the square for the next picture of the same camera.
    """

    pixels: Doubles
    visibility: Doubles
    mask: _Image
    square: Square


@dataclass(frozen=True)
class Square:
    """A turned square of the picture: middle (x, y) and side in pixels, angle in radians."""

    x: float
    y: float
    side: float
    angle: float

    def picture_from_square(self, side: int) -> Doubles:
        """(2, 3) f64 from the square's pixels (centres at integers) to the picture's."""
        scale = self.side / side
        turn = scale * np.array(
            [[np.cos(self.angle), -np.sin(self.angle)], [np.sin(self.angle), np.cos(self.angle)]]
        )
        middle = np.array([self.x - 0.5, self.y - 0.5])
        return np.c_[turn, middle - turn @ np.full(2, side / 2 - 0.5)]


class PersonFinder:
    """Both networks, loaded once.

    Raises:
        MissingInput: networks or runtime are not installed.
    """

    def __init__(self, threads: int = 2) -> None:
        self._detector = Network(model_bytes(DETECTOR), threads)
        self._landmarks = Network(model_bytes(LANDMARKS), threads)
        self._anchors = _anchors(self._detector.side)

    def __call__(self, image: _Image, square: Square | None = None) -> Person | None:
        """The person in a picture (H, W, 3) u8 sRGB; None when there is none.

        Arguments:
            square: where the person was in the picture before; the detector is asked when that fails.
        """
        person = None if square is None else self._look(image, square)
        if person is not None:
            return person
        detected = self._detect(image)
        if detected is None:
            return None
        person = self._look(image, detected)
        # The landmarks know the body's circle better than the detector does.
        return None if person is None else self._look(image, person.square) or person

    def _detect(self, image: _Image) -> Square | None:
        """The square around the most certain person, in the whole picture or else in a part of it."""
        for square in _windows(image):
            best = self._detect_in(image, square)
            if best is not None:
                return best
        return None

    def _detect_in(self, image: _Image, window: Square) -> Square | None:
        side = self._detector.side
        picture_from_square = window.picture_from_square(side)
        outputs = self._detector(_sampled(image, picture_from_square, side) * 2 - 1)
        scores = _sigmoid(outputs[(1, len(self._anchors), 1)].reshape(-1).astype(np.float64))
        best = int(scores.argmax())
        if scores[best] < _LEAST_SCORE:
            return None
        values = outputs[(1, len(self._anchors), _BOX_VALUES)][0, best].astype(np.float64)
        anchor = side * self._anchors[best]
        return _square_of(
            _moved(picture_from_square, values[_MIDDLE : _MIDDLE + 2] + anchor - 0.5),
            _moved(picture_from_square, values[_TOP : _TOP + 2] + anchor - 0.5),
        )

    def _look(self, image: _Image, square: Square) -> Person | None:
        """Landmarks and mask in a square, or None when nobody is in it."""
        side = self._landmarks.side
        picture_from_square = square.picture_from_square(side)
        outputs = self._landmarks(_sampled(image, picture_from_square, side))
        if float(outputs[(1, 1)].reshape(-1)[0]) < _LEAST_PRESENCE:
            return None
        values = outputs[(1, _ALL_LANDMARKS * _VALUES)].reshape(_ALL_LANDMARKS, _VALUES).astype(np.float64)
        heat = next(value for shape, value in outputs.items() if shape[-1] == _ALL_LANDMARKS)[0]
        places = _refined(values[:, :2], _sigmoid(heat.astype(np.float64)), side)
        pixels = _moved(picture_from_square, places - 0.5) + 0.5
        mask = _sigmoid(outputs[(1, side, side, 1)][0, ..., 0])
        height, width = image.shape[:2]
        spread = cv2.warpAffine(
            mask.astype(np.float32), picture_from_square, (width, height), flags=cv2.INTER_LINEAR
        )
        return Person(
            pixels[:LANDMARK_COUNT],
            _sigmoid(values[:LANDMARK_COUNT, 3]) * _sigmoid(values[:LANDMARK_COUNT, 4]),
            np.rint(255 * np.clip(spread, 0, 1)).astype(np.uint8),
            _square_of(pixels[_CIRCLE[0]] - 0.5, pixels[_CIRCLE[1]] - 0.5),
        )


def _windows(image: _Image) -> list[Square]:
    """The whole picture in a square, then overlapping squares of its short side for people who are small."""
    height, width = image.shape[:2]
    long, short = max(height, width), min(height, width)
    windows = [Square(width / 2, height / 2, long, 0.0)]
    for place in np.linspace(short / 2, long - short / 2, 3):
        x, y = (place, height / 2) if width > height else (width / 2, place)
        windows.append(Square(float(x), float(y), short, 0.0))
    return windows


def _square_of(middle: Doubles, end: Doubles) -> Square:
    """The square around a body's circle, turned so that its end is above its middle."""
    way = end - middle
    angle = float(np.arctan2(way[1], way[0]) + np.pi / 2)
    radius = float(np.hypot(*way))
    return Square(float(middle[0]) + 0.5, float(middle[1]) + 0.5, 2 * _MARGIN * max(radius, 1.0), angle)


def _sampled(image: _Image, picture_from_square: Doubles, side: int) -> Singles:
    """(side, side, 3) f32 in [0, 1] of a turned square; black outside of the picture."""
    scale = float(np.hypot(*picture_from_square[:, 0]))
    if scale > 2:  # smaller pictures are averages, not every so many pixels
        blurred = cv2.GaussianBlur(image, (0, 0), 0.35 * scale)
    else:
        blurred = image
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    part = cv2.warpAffine(blurred, picture_from_square, (side, side), flags=flags)
    return part.astype(np.float32) / np.float32(255)


def _refined(places: Doubles, heat: Doubles, side: int) -> Doubles:
    """Landmarks (L, 2) moved to the weighted middle of the heat around them, where there is enough heat."""
    rows, columns = heat.shape[:2]
    result = places.copy()
    for number, (x, y) in enumerate(places):
        column, row = int(x / side * columns), int(y / side * rows)
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        top, left = max(row - _HEATMAP_REACH, 0), max(column - _HEATMAP_REACH, 0)
        part = heat[top : row + _HEATMAP_REACH + 1, left : column + _HEATMAP_REACH + 1, number]
        if part.max() < _LEAST_HEAT:
            continue
        ys, xs = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
        total = part.sum()
        result[number] = (
            (part * (xs + 0.5)).sum() / total / columns * side,
            (part * (ys + 0.5)).sum() / total / rows * side,
        )
    return result


def _anchors(side: int) -> Doubles:
    """(A, 2) middles of the detector's anchors as shares of the side."""
    anchors = []
    for stride, count in _STRIDES:
        cells = side // stride
        middles = (np.arange(cells) + 0.5) / cells
        grid = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
        anchors.append(np.repeat(grid, count, axis=0))
    return np.concatenate(anchors)


def _moved(matrix: Doubles, points: Doubles) -> Doubles:
    return np.asarray(points @ matrix[:, :2].T + matrix[:, 2], np.float64)


def _sigmoid(values: NDArray) -> NDArray:
    return 1 / (1 + np.exp(-np.clip(values, -60, 60)))
