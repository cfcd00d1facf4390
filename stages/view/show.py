"""What the page asks for: Gaussians of a moment, and pictures by the renderer itself. No network in here."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stages.shared.artifacts.pictures import encode_png
from stages.shared.body import Poses, canonical_poses
from stages.shared.capture.camera import Camera, checked_camera
from stages.shared.errors import UsageProblem
from stages.shared.layers import SLOTS
from stages.shared.outfit.foot_height import fix_foot_height
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.sources import parse_betas
from stages.shared.outfit.viewpoints import viewpoint_cameras
from stages.shared.pictures.background import read_background
from stages.shared.web.pack import pack_gaussians
from stages.shared.web.start import orbit_start
from stages.view.shelf import Shelf

AS_THEY_ARE = ("canonical pose", "own motion")  # names of motions that no file brought
_KEPT_MOTIONS = 8
LARGEST_SIDE = 4096  # px of a picture
_PLAIN = re.compile("#[0-9a-fA-F]{6}|transparent")


@dataclass(frozen=True, eq=False)
class Wish:
    """A moment that the page wants to see.

    Attributes:
        wear: names of pieces. motion, row: which motion, and which of its frames.
        betas: "" for the body's own.
    """

    wear: tuple[str, ...] = ()
    motion: int = 0
    row: int = 0
    betas: str = ""


class Show:
    """Answers wishes, one at a time.

    Arguments:
        motions: names and poses to play.
        size: width and height that the first camera is framed for, px.
    """

    def __init__(self, shelf: Shelf, motions: Sequence[tuple[str, Poses]], size: tuple[int, int]) -> None:
        self.shelf, self.motions, self._size = shelf, list(motions), size
        self._one = threading.Lock()
        self._walked: OrderedDict[tuple[int, bytes], Poses] = OrderedDict()

    def described(self, betas: str) -> dict[str, Any]:
        """All that the page needs to begin. betas: of the first view."""
        outfit = self.shelf.outfit(self.shelf.worn, parse_betas(betas))
        poses = self._on_the_floor(0, outfit)[0]
        size = self._size
        (camera,) = viewpoint_cameras("static", outfit.body_model, poses, outfit.betas, size)
        return {
            "pieces": self.shelf.described(),
            "slots": list(SLOTS),
            "wear": list(self.shelf.worn),
            "betasAsked": betas,
            "betas": [round(float(value), 4) for value in outfit.betas],
            "motions": [
                {"name": name, "frames": len(poses), "fps": poses.fps} for name, poses in self.motions
            ],
            "start": orbit_start(camera, outfit.composite(poses, 0)),
        }

    def gaussians(self, wish: Wish) -> bytes:
        """Packed Gaussians (stages/shared/web/pack.py)."""
        with self._one:
            outfit, poses = self._wished(wish)
            return pack_gaussians(outfit.composite(poses, wish.row))

    def picture(self, wish: Wish, camera: Camera, hidden: Sequence[str], background: str) -> bytes:
        """PNG by the renderer of `gw render`, penetration pass included; transparent on request."""
        if max(camera.width, camera.height) > LARGEST_SIDE:
            raise UsageProblem(
                f"A picture of {camera.width} x {camera.height} px is too large.",
                "camera",
                f"Ask for at most {LARGEST_SIDE} px.",
            )
        if not _PLAIN.fullmatch(background):  # a path would be read from this machine's disk
            raise UsageProblem(
                f"{background[:40]!r} is no colour.", "background", "Give #rrggbb or transparent."
            )
        behind = read_background(background)
        with self._one:
            outfit, poses = self._wished(wish)
            layers = tuple(layer for layer in outfit.layers if layer.name not in hidden)
            if not layers:
                raise UsageProblem("All layers are off.", "layers", "Leave one on.")
            composite = replace(outfit, layers=layers).composite(poses, wish.row)
            shot = render_image(composite, camera, self.shelf.margins)
        straight = shot.straight()
        return encode_png(straight if behind.transparent else behind.under(straight))

    def _wished(self, wish: Wish) -> tuple[Outfit, Poses]:
        if not 0 <= wish.motion < len(self.motions):
            raise UsageProblem(f"There is no motion {wish.motion}.", "motion", "Choose one of the list.")
        poses = self.motions[wish.motion][1]
        if not 0 <= wish.row < len(poses):
            raise UsageProblem(f"There is no frame {wish.row}.", "row", f"Choose 0 to {len(poses) - 1}.")
        outfit = self.shelf.outfit(wish.wear, parse_betas(wish.betas))
        return outfit, self._on_the_floor(wish.motion, outfit)

    def _on_the_floor(self, motion: int, outfit: Outfit) -> Poses:
        """A motion from a file on the wearer's legs, as `gw render` has it; other motions as they are."""
        name, poses = self.motions[motion]
        if name in AS_THEY_ARE:
            return poses
        key = (motion, outfit.betas.tobytes())
        if key not in self._walked:
            self._walked[key] = fix_foot_height(poses, outfit.body_model, outfit.betas)
        self._walked.move_to_end(key)
        while len(self._walked) > _KEPT_MOTIONS:
            self._walked.popitem(last=False)
        return self._walked[key]


def canonical_motion() -> tuple[str, Poses]:
    """One frame in the pose of the maps."""
    return AS_THEY_ARE[0], canonical_poses()


def camera_of(content: Any) -> Camera:
    """A camera as viewer.js has it: width, height, intrinsics (fx, fy, cx, cy), cameraFromWorld (16 numbers).

    Raises UsageProblem or BadData.
    """
    try:
        fx, fy, cx, cy = (float(number) for number in content["intrinsics"])
        matrix = np.array([float(number) for number in content["cameraFromWorld"]]).reshape(4, 4)
        width, height = int(content["width"]), int(content["height"])
    except (KeyError, TypeError, ValueError) as error:
        raise UsageProblem("The camera is not understood.", "camera", "Reload the page.") from error
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return checked_camera("view", width, height, intrinsics, matrix, "camera")
