"""The background of videos and contact sheets: a colour, transparency, or a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData, UsageProblem

_NAMED = {"white": "#ffffff", "black": "#000000", "grey": "#808080", "gray": "#808080"}
_SUFFIXES = (".png", ".jpg", ".jpeg")
_CHECKER = (0.92, 0.80)  # tones of a contact sheet where the background is transparent


@dataclass(frozen=True, eq=False)
class Background:
    """A colour, a picture, or (with neither) transparency.

    Attributes:
        color: sRGB 0..1. picture: (H, W, 3) u8 sRGB; it covers the frame and is cropped about its centre.
    """

    color: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    picture: NDArray[np.uint8] | None = None

    @property
    def transparent(self) -> bool:
        """Whether there is neither colour nor picture."""
        return self.color is None and self.picture is None

    def behind(self, height: int, width: int) -> NDArray[np.float32]:
        """(height, width, 3) f32 sRGB 0..1; a chequered pattern for a transparent one."""
        if self.picture is not None:
            return np.asarray(_covering(self.picture, height, width), np.float32) / np.float32(255)
        if self.color is not None:
            return np.broadcast_to(np.asarray(self.color, np.float32), (height, width, 3))
        rows, columns = np.mgrid[:height, :width] // 8
        tones = np.where((rows + columns) % 2 == 0, *_CHECKER).astype(np.float32)
        return np.repeat(tones[..., None], 3, axis=2)

    def under(self, straight: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) u8: a picture with straight alpha (H, W, 4) u8 over this background."""
        alpha = straight[..., 3:].astype(np.float32) / 255
        shown = straight[..., :3] * alpha + 255 * (1 - alpha) * self.behind(*straight.shape[:2])
        return np.rint(np.clip(shown, 0, 255)).astype(np.uint8)


WHITE = Background()


def read_background(text: str) -> Background:
    """The background that an option names: white, black, grey, #rrggbb, transparent, or a picture's path.

    Raises:
        UsageProblem: none of these. BadData: the picture cannot be read.
    """
    if text == "transparent":
        return Background(None)
    if Path(text).suffix.lower() in _SUFFIXES:
        return Background(None, _picture(Path(text)))
    value = _NAMED.get(text, text)
    try:
        if len(value) != 7 or value[0] != "#":
            raise ValueError
        red, green, blue = (int(value[at : at + 2], 16) / 255 for at in (1, 3, 5))
    except ValueError:
        raise UsageProblem(
            f"{text!r} is no background.",
            "option --background",
            "Give white, black, grey, #rrggbb, transparent, or a PNG or JPEG file.",
        ) from None
    return Background((red, green, blue))


def _picture(path: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if picture is None:
        raise BadData("The background picture cannot be read.", str(path), "Give a PNG or JPEG file.")
    return np.asarray(picture[..., ::-1], np.uint8)


def _covering(picture: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    factor = max(height / picture.shape[0], width / picture.shape[1])
    size = (max(width, round(picture.shape[1] * factor)), max(height, round(picture.shape[0] * factor)))
    smaller = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(np.ascontiguousarray(picture), size, interpolation=smaller)
    top, left = (resized.shape[0] - height) // 2, (resized.shape[1] - width) // 2
    return np.asarray(resized[top : top + height, left : left + width], np.uint8)
