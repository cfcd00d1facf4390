"""What is decided before a picture is written: recordings, lenses, times, where masks come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from stages.import_capture import videos
from stages.import_capture.config import MASKS, UPS, ImportConfig
from stages.import_capture.frames import first_picture
from stages.import_capture.lenses import fitted_lens
from stages.import_capture.masks import MaskSource, choose_masks
from stages.import_capture.media import Recording, by_camera, find_recordings, frame_table
from stages.shared.calibration.model import Calibration
from stages.shared.calibration.read import KINDS, find_calibration, read_calibration
from stages.shared.calibration.undistort import Undistortion, undistortion
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.vision.models import problem


@dataclass(frozen=True, eq=False)
class ImportSource:
    """What will be imported, and how."""

    calibration: Calibration
    recordings: dict[str, Recording]
    lenses: dict[str, Undistortion]
    table: dict[str, list[int | None]]
    fps: float
    masks: MaskSource
    landmarks: bool
    notes: list[str]

    @property
    def rows(self) -> int:
        """Frames of the take."""
        return len(next(iter(self.table.values())))


def prepare(source: Path, config: ImportConfig, calibration: Path | None) -> ImportSource:
    """Assign recordings to cameras and choose where masks come from; errors as `stage.run`."""
    if config.up not in UPS or config.masks not in MASKS:
        raise UsageProblem(
            f"--up {config.up} or --masks {config.masks} is not known.",
            "options --up, --masks",
            f"Choose of {', '.join(UPS)} and of {', '.join(MASKS)}.",
        )
    recordings = find_recordings(source)
    place = calibration or find_calibration(source)
    if place is None:
        raise MissingInput(
            "There is no calibration.", str(source), f"Give --calibration. Known are: {'; '.join(KINDS)}."
        )
    cameras = read_calibration(place)
    assigned, notes = by_camera(recordings, cameras.cameras)
    for option, given in (("--held-out", config.held_out), ("--offset", tuple(config.offsets))):
        unknown = sorted(set(given) - set(assigned))
        if unknown:
            raise UsageProblem(
                f"There is no camera {unknown[0]!r}.", f"option {option}", "Choose of " + ", ".join(assigned)
            )
    notes = [f"{len(assigned)} cameras by {cameras.kind}", *cameras.notes, *notes]
    lenses, alphas = {}, []
    for name, recording in assigned.items():
        image, alpha = first_picture(recording)
        alphas.append(alpha is not None and int(alpha.min()) < 255)
        lens, note = fitted_lens(cameras.cameras[name], image)
        if note:
            notes.append(note)
        lenses[name] = undistortion(lens, config.alpha)
        if recording.video is not None and videos.high_dynamic_range(recording.video):
            notes.append(f"{name}: the video has an HDR curve; its colours are read as they are")
    fps, table = frame_table(assigned, config.fps, config.offsets, config.frames)
    rows = len(next(iter(table.values())))
    if rows <= config.test_frames:
        raise UsageProblem(
            f"The recordings have {rows} frames in common; {config.test_frames} are for testing.",
            "options --frames, --test-frames, --offset",
            "Leave at least one frame for training.",
        )
    masks = choose_masks(source, assigned, config, all(alphas))
    return ImportSource(
        cameras,
        assigned,
        lenses,
        table,
        fps,
        masks,
        _wants_landmarks(config, masks),
        _lens_notes(lenses, notes),
    )


def _wants_landmarks(config: ImportConfig, masks: MaskSource) -> bool:
    """Landmarks come with the network's masks; otherwise where it is installed, or was asked for."""
    if masks.kind == "network" or config.landmarks or config.refine_cameras:
        return True
    return config.landmarks is None and problem() is None


def _lens_notes(lenses: Mapping[str, Undistortion], notes: list[str]) -> list[str]:
    bent = [name for name, lens in lenses.items() if lens.columns is not None]
    if bent:
        notes.append(f"{len(bent)} cameras are undistorted at their own resolution")
    return notes
