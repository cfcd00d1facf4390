"""What the viewer's page requests: Gaussians of one frame or of many, the wearer's shape, and pictures.

This module knows nothing about the network.
"""

from __future__ import annotations

import re
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stages.shared.artifacts.pictures import encode_png
from stages.shared.body import Poses, canonical_poses
from stages.shared.capture.calibration import checked_camera
from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.layers import SLOTS
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.retarget import fix_foot_height
from stages.shared.outfit.sources import parse_betas
from stages.shared.outfit.viewpoints import viewpoint_cameras
from stages.shared.pictures.background import read_background
from stages.shared.web.pack import pack_gaussians
from stages.shared.web.start import orbit_start
from stages.view.catalog import BundleCatalog
from stages.view.measures import body_measures

UNCHANGED_MOTIONS = ("canonical pose", "own motion")  # names of motions that no file brought
_CACHED_MOTIONS = 8
LARGEST_SIDE, LARGEST_PICTURE = 4096, 3840 * 2160  # pixels
_COLOR = re.compile("#[0-9a-fA-F]{6}|transparent")


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """A frame that the page asks for.

    Attributes:
        wear: names of bundles. motion, row: which motion, and which of its rows.
        betas: body shape, "" for the body's own.
    """

    wear: tuple[str, ...] = ()
    motion: int = 0
    row: int = 0
    betas: str = ""


class ViewerSession:
    """Answers requests. Posing and rendering go one at a time.

    Arguments:
        motions: names and poses to play.
        size: width and height that the first camera is framed for, px.
    """

    def __init__(
        self, catalog: BundleCatalog, motions: Sequence[tuple[str, Poses]], size: tuple[int, int]
    ) -> None:
        self.catalog, self.motions, self._size = catalog, list(motions), size
        self._lock = threading.Lock()
        self._grounded: OrderedDict[tuple[int, bytes], Poses] = OrderedDict()
        self._poser: CachedPoser | None = None

    def described(self, betas: str) -> dict[str, Any]:
        """Everything that the page needs to start. betas: of the first view."""
        outfit = self.catalog.outfit(self.catalog.worn, parse_betas(betas))
        poses = self._grounded_motion(0, outfit)[0]
        (camera,) = viewpoint_cameras("static", outfit.body_model, poses, outfit.betas, self._size)
        return {
            "pieces": self.catalog.described(),
            "slots": list(SLOTS),
            "wear": list(self.catalog.worn),
            "betasAsked": betas,
            "motions": [
                {"name": name, "frames": len(poses), "fps": poses.fps} for name, poses in self.motions
            ],
            "start": orbit_start(camera, outfit.composite(poses, 0)),
        }

    def body(self, request: FrameRequest) -> dict[str, Any]:
        """Shape of the body that is worn: its own coefficients, and height and girth (cm) as requested."""
        with self._lock:
            own = self.catalog.outfit(request.wear, None)
            shape = parse_betas(request.betas)
            worn = own if shape is None else replace(own, betas=shape)
            return {
                "betas": [round(float(value), 4) for value in own.betas],
                **body_measures(worn.body_model, worn.betas),
            }

    def gaussians(self, request: FrameRequest) -> bytes:
        """Packed Gaussians of one frame (stages/shared/web/pack.py)."""
        with self._lock:
            poser, poses = self._prepared(request)
            return pack_gaussians(poser.composite(poses, request.row), row=request.row)

    def stream(self, request: FrameRequest) -> Iterator[bytes]:
        """Packed Gaussians of the rows from `request.row` on, in a loop, until the caller stops.

        Rows that are late at the motion's own speed are left out. Later rows are made in advance.

        Raises (at once): as `gaussians`.
        """
        with self._lock:
            poser, poses = self._prepared(request, cached=False)

        def frames() -> Iterator[bytes]:
            started, place = time.monotonic(), -1
            while True:
                due = int((time.monotonic() - started) * poses.fps)
                place = max(place + 1, due)
                row = (request.row + place) % len(poses)
                with self._lock:
                    packed = pack_gaussians(poser.composite(poses, row), row=row, place=place)
                yield packed

        return frames()

    def picture(self, request: FrameRequest, camera: Camera, hidden: Sequence[str], background: str) -> bytes:
        """PNG by the renderer of `gw render`, penetration pass included; transparent on request."""
        if max(camera.width, camera.height) > LARGEST_SIDE or camera.width * camera.height > LARGEST_PICTURE:
            raise UsageProblem(
                f"A picture of {camera.width} x {camera.height} px is too large.",
                "camera",
                f"Ask for at most {LARGEST_SIDE} px a side and {LARGEST_PICTURE} in all.",
            )
        if not _COLOR.fullmatch(background):  # a path would be read from this machine's disk
            raise UsageProblem(
                f"{background[:40]!r} is not a colour.", "background", "Give #rrggbb or transparent."
            )
        behind = read_background(background)
        with self._lock:
            outfit, poses = self._requested(request)
            layers = tuple(layer for layer in outfit.layers if layer.name not in hidden)
            if not layers:
                raise UsageProblem("All layers are off.", "layers", "Leave one on.")
            gaussians = replace(outfit, layers=layers).composite(poses, request.row)
            image = render_image(gaussians, camera, self.catalog.margins)
        straight = image.straight()
        return encode_png(straight if behind.transparent else behind.under(straight))

    def _prepared(self, request: FrameRequest, cached: bool = True) -> tuple[CachedPoser, Poses]:
        """A poser of the outfit; with `cached` the last one, whose Gaussians the next call overwrites."""
        outfit, poses = self._requested(request)
        if self._poser is None or self._poser.outfit is not outfit:
            self._poser = CachedPoser(outfit)
        poser = self._poser
        return (poser if cached else CachedPoser(outfit, share_with=poser)), poses

    def _requested(self, request: FrameRequest) -> tuple[Outfit, Poses]:
        if not 0 <= request.motion < len(self.motions):
            raise UsageProblem(f"There is no motion {request.motion}.", "motion", "Choose one of the list.")
        poses = self.motions[request.motion][1]
        if not 0 <= request.row < len(poses):
            raise UsageProblem(f"There is no frame {request.row}.", "row", f"Choose 0 to {len(poses) - 1}.")
        trained = poses is self.catalog.subject_poses
        outfit = self.catalog.outfit(request.wear, parse_betas(request.betas), trained)
        return outfit, self._grounded_motion(request.motion, outfit)

    def _grounded_motion(self, motion: int, outfit: Outfit) -> Poses:
        """A motion from a file on the wearer's legs, as `gw render` has it; other motions as they are."""
        name, poses = self.motions[motion]
        if name in UNCHANGED_MOTIONS:
            return poses
        key = (motion, outfit.betas.tobytes())
        if key not in self._grounded:
            self._grounded[key] = fix_foot_height(poses, outfit.body_model, outfit.betas)
        self._grounded.move_to_end(key)
        while len(self._grounded) > _CACHED_MOTIONS:
            self._grounded.popitem(last=False)
        return self._grounded[key]


def canonical_motion() -> tuple[str, Poses]:
    """One frame in the pose of the maps."""
    return UNCHANGED_MOTIONS[0], canonical_poses()


def camera_of(content: Any) -> Camera:
    """A camera as viewer.js has it: width, height, intrinsics (fx, fy, cx, cy), cameraFromWorld (16 numbers).

    Raises UsageProblem or BadData.
    """
    try:
        fx, fy, cx, cy = (float(number) for number in content["intrinsics"])
        matrix = np.array([float(number) for number in content["cameraFromWorld"]]).reshape(4, 4)
        width, height = int(content["width"]), int(content["height"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UsageProblem("The camera is not understood.", "camera", "Reload the page.") from error
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return checked_camera("view", width, height, intrinsics, matrix, "camera")
