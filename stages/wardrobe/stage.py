"""All sensible outfits of a wardrobe, side by side, and whether any of them has holes.

Reads:
    DIR/*.gwg: bodies and garments; a pose file (the bodies' canonical pose without).
Writes, into the output folder:
    outfits.png: one cell per outfit, as seen from front and back; outfits.json: per outfit its pieces, hole
    pixels (of all its pictures) and pixels that the penetration pass repaired.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.bundle import Bundle, read_bundle
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.files import write_file
from stages.shared.artifacts.pictures import encode_png
from stages.shared.body import Poses, canonical_poses
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.penetration import TRYON_MARGINS
from stages.shared.outfit.render_image import RenderedImage, render_image
from stages.shared.outfit.viewpoints import look_at_camera
from stages.shared.outfit.wardrobe import Piece, count_outfits, pieces, sensible_outfits
from stages.shared.pictures.folder import check_output, output_folder
from stages.shared.pictures.sheet import contact_sheet
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report
from stages.wardrobe.config import OutfitsConfig
from stages.wardrobe.holes import hole_pixels

MARK = "gw-wardrobe-outfits"
RESULT_NAME = "outfits.json"
_PAPER = (1.0, 1.0, 1.0)
_MARGIN = 0.05  # m around the Gaussians


@dataclass(frozen=True)
class OutfitsResult:
    """The folder, and what was found."""

    path: Path
    summary: dict[str, Any]


def run(
    wardrobe: Path,
    output: Path,
    poses_path: Path | None = None,
    config: OutfitsConfig = OutfitsConfig(),
    report: Report = SILENT,
) -> OutfitsResult:
    """Render every body in every set of garments that go together.

    Raises:
        MissingInput: no body in the wardrobe. UsageProblem: more outfits than `most`.
    """
    started = time.monotonic()
    check_output(output, RESULT_NAME, MARK)
    catalogue = pieces(wardrobe)
    count = count_outfits(catalogue)
    if not count:
        raise MissingInput(
            "The wardrobe has no body.", str(wardrobe), "Add one: gw wardrobe add DIR body.gwg."
        )
    if count > config.most:
        raise UsageProblem(
            f"There are {count} outfits, more than {config.most}.",
            str(wardrobe),
            "Make a smaller wardrobe, or raise --most.",
        )
    outfits = list(sensible_outfits(catalogue))
    report.step(f"rendering {len(outfits)} outfits")
    cells, captions, rows = [], [], []
    bundles: dict[str, Bundle] = {}
    for index, worn in enumerate(outfits):
        for piece in worn:
            bundles.setdefault(piece.name, read_bundle(piece.path))
        outfit = outfit_of_bundles([(piece.name, bundles[piece.name]) for piece in worn]).driven(config.drive)
        shots = _shots(outfit, poses_path, config)
        cells.append(np.hstack([shot.on(_PAPER) for shot in shots]))
        captions.append(" ".join(piece.name for piece in worn))
        rows.append(_row(worn, outfit, shots))
        report.progress(index + 1, len(outfits))
    with output_folder(output, RESULT_NAME, MARK) as folder:
        sheet: NDArray[np.uint8] = contact_sheet(cells, min(config.columns, len(cells)), captions)
        write_file(folder / "outfits.png", encode_png(sheet))
        summary = {
            "outfits": len(outfits),
            "with_holes": sum(row["hole_pixels"] > 0 for row in rows),
            "hole_pixels": sum(row["hole_pixels"] for row in rows),
            "repaired_pixels": sum(row["repaired_pixels"] for row in rows),
            "seconds": round(time.monotonic() - started, 1),
        }
        content = {"format": MARK, "version": 1, **summary, "all": rows}
        write_file(folder / RESULT_NAME, readable_json(content))
    return OutfitsResult(output, summary)


def _shots(outfit: Outfit, poses_path: Path | None, config: OutfitsConfig) -> list[RenderedImage]:
    """The outfit from every side."""
    poses = canonical_poses() if poses_path is None else load_poses(poses_path, outfit.body_model)
    frame = len(poses) // 2 if config.frame < 0 else config.frame
    if frame >= len(poses):
        raise UsageProblem(
            f"The motion has {len(poses)} frames.", "option --frame", f"Give 0 to {len(poses) - 1}."
        )
    composite = outfit.composite(poses, frame)
    means = composite.means.double().numpy()
    low, high = means.min(axis=0) - _MARGIN, means.max(axis=0) + _MARGIN
    facing = float(np.arctan2(*_forward(poses, frame)))
    across = np.abs((means - (low + high) / 2) @ np.array([np.cos(facing), 0, -np.sin(facing)])).max()
    half = (float(across) + _MARGIN, float(high[1] - low[1]) / 2, 0.3)
    size = (config.width, config.height)
    return [
        render_image(
            composite,
            look_at_camera("outfit", (low + high) / 2, facing + np.deg2rad(azimuth), half, size),
            TRYON_MARGINS,
        )
        for azimuth in config.azimuths
    ]


def _forward(poses: Poses, frame: int) -> tuple[float, float]:
    """x and z of where the body faces."""
    from scipy.spatial.transform import Rotation

    forward = Rotation.from_rotvec(poses.rotations[frame, 0].astype(np.float64)).apply([0.0, 0.0, 1.0])
    return float(forward[0]), float(forward[2])


def _row(worn: tuple[Piece, ...], outfit: Outfit, shots: list[RenderedImage]) -> dict[str, Any]:
    return {
        "pieces": [piece.name for piece in worn],
        "layers": list(outfit.names),
        "gaussians": outfit.gaussians,
        "hole_pixels": sum(hole_pixels(shot.alpha) for shot in shots),
        "repaired_pixels": int(sum(int(shot.repaired.sum()) for shot in shots if shot.repaired is not None)),
    }
