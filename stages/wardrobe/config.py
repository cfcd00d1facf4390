"""Settings of `gw wardrobe outfits`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class OutfitsConfig:
    """How all outfits are shown.

    Attributes:
        frame: row of the pose file; −1 for the middle one. width, height: pixels of one picture.
        azimuths: degrees from the front, one picture each.
        columns: outfits in a row of the sheet.
        most: outfits that are shown at most.
        drive: what moves garments, as in `gw render`.
    """

    frame: int = -1
    width: int = 150
    height: int = 240
    azimuths: tuple[float, ...] = (0.0, 180.0)
    columns: int = 6
    most: int = 256
    drive: str = "auto"
