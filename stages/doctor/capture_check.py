"""What is wrong with a capture, a sentence each: sharpness, light, masks, calibration, sync, coverage."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture import Capture, Take
from stages.shared.capture.landmarks import Landmarks, landmarks_file, read_landmarks
from stages.shared.capture.take import MASK_THRESHOLD
from stages.shared.report import SILENT, Report
from stages.shared.vision.consistency import consistent_masks, meeting_point

Doubles = NDArray[np.float64]

_FRAMES = 3  # of each take that are looked at
_BLURRED = 0.35  # sharpness against the median of the cameras
_BLACK, _WHITE, _CLIPPED = 5, 250, 0.10
_SMALL_PERSON = 300  # pixels of height
_WIDEST_GAP = 130.0  # degrees between two neighbouring cameras
_MASK_AGREES, _CUT_OFF = 0.90, 0.02
_LANDMARK_SHARE = 0.02  # of the person's height
_LATE_FRAMES = 0.5
_FEWEST_MOTION = 50.0  # pixels² of motion that a delay is told from


def check_capture(capture: Capture, report: Report = SILENT) -> list[str]:
    """Findings about a capture, most of them with a cure; empty when nothing is wrong.

    A few frames of each take are read. Landmarks are used where the capture brings some (`gw import`).

    Raises:
        BadData: pictures or masks that cannot be read.
    """
    findings: list[str] = []
    for take in capture.takes:
        report.step(f"looking at {take.name}")
        frames = sorted(
            {take.frames[row] for row in np.linspace(0, len(take.frames) - 1, _FRAMES).astype(int)}
        )
        findings += _picture_findings(take, frames)
        findings += _mask_findings(take, frames[0])
        findings += _coverage_findings(take, frames[0])
        path = landmarks_file(take)
        if path is not None:
            findings += landmark_findings(take, read_landmarks(path))
    return findings


def _picture_findings(take: Take, frames: list[int]) -> list[str]:
    """Blur, clipped light and small people, by camera."""
    sharp: dict[str, float] = {}
    findings = []
    for name in take.cameras:
        values, dark, bright, heights = [], [], [], []
        for frame in frames:
            if not take.has_image(name, frame):
                continue
            inside = take.mask(name, frame) > MASK_THRESHOLD
            if not inside.any():
                continue
            grey = cv2.cvtColor(take.image(name, frame), cv2.COLOR_RGB2GRAY)
            core = cv2.erode(inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            values.append(float(cv2.Laplacian(grey, cv2.CV_64F)[core].var()) if core.any() else 0.0)
            dark.append(float((grey[inside] <= _BLACK).mean()))
            bright.append(float((grey[inside] >= _WHITE).mean()))
            heights.append(int(np.ptp(np.flatnonzero(inside.any(axis=1)))) + 1)
        if not values:
            findings.append(f"{take.name}, {name}: no mask shows the person; leave this camera out.")
            continue
        sharp[name] = float(np.median(values))
        for share, what, cure in ((dark, "black", "more light"), (bright, "white", "a shorter exposure")):
            percent = 100 * float(np.median(share))
            if percent > 100 * _CLIPPED:
                findings.append(f"{take.name}, {name}: {percent:.0f} % of the person is {what}; use {cure}.")
        if np.median(heights) < _SMALL_PERSON:
            findings.append(
                f"{take.name}, {name}: the person is {np.median(heights):.0f} pixels tall; go nearer, or use "
                f"more pixels ({_SMALL_PERSON} or more)."
            )
    return findings + _blurred(take, sharp)


def _blurred(take: Take, sharp: Mapping[str, float]) -> list[str]:
    usual = float(np.median(list(sharp.values()))) if sharp else 0.0
    return [
        f"{take.name}, {name}: blurred against the other cameras; check focus and exposure time."
        for name, value in sharp.items()
        if value < _BLURRED * usual
    ]


def _mask_findings(take: Take, frame: int) -> list[str]:
    """People cut off by the border, inverted masks, and masks that the other views contradict."""
    names = [name for name in take.cameras if take.has_image(name, frame)]
    masks = [take.mask(name, frame) for name in names]
    corrected = consistent_masks([take.camera(name) for name in names], masks)
    findings = []
    for name, mask, better in zip(names, masks, corrected, strict=True):
        inside, agreed = mask > MASK_THRESHOLD, better > MASK_THRESHOLD
        where = f"{take.name}, {name}"
        border = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
        if border.mean() > 0.5:
            findings.append(f"{where}: the mask covers the border of the picture; it may be inverted.")
        elif border.mean() > _CUT_OFF:
            findings.append(f"{where}: the person is cut off by the border; move the camera.")
        union = (inside | agreed).sum()
        if union and (inside & agreed).sum() / union < _MASK_AGREES:
            findings.append(
                f"{where}: the other views agree with {100 * (inside & agreed).sum() / union:.0f} % of the "
                "mask; check this mask and this camera's calibration."
            )
    return findings


def _coverage_findings(take: Take, frame: int) -> list[str]:
    """Few cameras, and wide gaps between them as the person sees them."""
    names = [name for name in take.training_cameras if take.has_image(name, frame)]
    cameras = [take.camera(name) for name in names]
    masks = [take.mask(name, frame) for name in names]
    shown = [index for index, mask in enumerate(masks) if (mask > MASK_THRESHOLD).any()]
    if len(shown) < 2:
        return [f"{take.name}: {len(shown)} cameras show the person in frame {frame}; 4 or more are needed."]
    middle = meeting_point([cameras[i] for i in shown], [masks[i] for i in shown])
    ways = np.stack([cameras[index].centre - middle for index in shown])
    angles = np.sort(np.degrees(np.arctan2(ways[:, 0], ways[:, 2])))
    gap = float(np.diff(np.append(angles, angles[0] + 360)).max())
    if gap > _WIDEST_GAP:
        return [
            f"{take.name}: {gap:.0f} degrees around the person are seen by no camera; what is there is "
            "guessed. Put a camera there, or turn the person."
        ]
    return []


def landmark_findings(take: Take, landmarks: Landmarks) -> list[str]:
    """Cameras whose landmarks disagree with the others: calibration, or sync where the disagreement moves."""
    findings = []
    for number, name in enumerate(landmarks.cameras):
        if name not in take.cameras:
            continue
        seen = landmarks.pixels[number].astype(np.float64)
        known = np.asarray(np.isfinite(landmarks.points).all(axis=-1))
        projected = take.cameras[name].project(np.where(known[..., None], landmarks.points, 0.0))[0]
        away = np.where(known[..., None], seen - projected, np.nan)
        if not np.isfinite(away).any():
            continue
        late = _frames_late(away, projected, known)
        if late is not None and abs(late) > _LATE_FRAMES:
            word = "behind" if late > 0 else "ahead of"
            findings.append(
                f"{take.name}, {name}: {abs(late):.1f} frames {word} the other cameras; add "
                f"{-late / take.fps:+.3f} s to its --offset and import again."
            )
            continue
        error = float(np.nanmedian(np.linalg.norm(away, axis=-1)))
        height = float(np.nanmedian(np.nanmax(seen[..., 1], axis=1) - np.nanmin(seen[..., 1], axis=1)))
        if error > _LANDMARK_SHARE * height:
            findings.append(
                f"{take.name}, {name}: landmarks are {error:.0f} pixels from where the other cameras see "
                "them; calibrate again, or import with --refine-cameras."
            )
    return findings


def _frames_late(away: Doubles, projected: Doubles, known: NDArray[np.bool_]) -> float | None:
    """By how many frames a camera shows the past: the disagreement along the motion over the motion.

    A camera that is late by d frames sees x(t - d) ≈ x(t) - d v, so away = -d v.
    """
    if len(away) < 5:
        return None
    motion = np.gradient(projected, axis=0)
    usable = known & np.isfinite(away).all(axis=-1)
    usable[[0, -1]] = False
    along, squared = (away * motion).sum(axis=-1)[usable], (motion**2).sum(axis=-1)[usable]
    if squared.sum() < _FEWEST_MOTION or not len(squared):
        return None
    fast = squared >= np.median(squared)
    return -float(along[fast].sum() / squared[fast].sum())
