"""Registration of a capture: body and masks checked or fitted, the dressed surface of one frame made."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.fitting.fit_capture import fit_takes
from stages.register_template.frame_choice import choose_frame
from stages.register_template.scan_cleaning import clean_scan
from stages.register_template.sources import Registered, Source, frames_checked
from stages.register_template.surface import distances, make_surface
from stages.shared.body import Poses
from stages.shared.body.posed import posed_body
from stages.shared.capture import Capture, Take
from stages.shared.capture.alignment import check_alignment, overlay_picture, silhouette_ious
from stages.shared.capture.convention import AS_IS, take_in_convention
from stages.shared.capture.open_capture import with_poses
from stages.shared.report import Report

_FITTED_BAR = 0.80


def register_capture(source: Source, config: RegisterTemplateConfig, report: Report) -> Registered:
    """Check the alignment and make the template of a capture; fit the body first when that is asked for."""
    capture, take, body = source.capture, source.take, source.body
    assert capture is not None and take is not None
    for note in capture.notes:
        report.say(note)
    fitted = dict(source.converted)
    told: dict[str, Any] = {}
    if source.fits_body:
        found, told = _fit(source, capture, take, config, report)
        fitted |= found
        capture = with_poses(capture, found)
        take = capture.take(take.name)
    frame = source.frame if source.frame is not None else choose_frame(body, take.poses, take.frames)
    report.step("projecting the body into the masks")
    checked = {number: posed_body(body, take.poses[number]) for number in frames_checked(take, frame)}
    alignment = check_alignment(take, checked, body.faces, alignment_bar(config, source.fits_body))
    if alignment.convention != AS_IS:
        report.warn(f"camera matrices are read with: {alignment.convention}")
        take = take_in_convention(take, alignment.convention)
    for warning in alignment.warnings:
        report.warn(warning)
    report.say(f"{100 * alignment.mean_inside:.1f} % of the body's silhouette lies inside the masks")

    posed = checked[frame]
    template, how = make_surface(source.template, take, frame, posed, body, config, report)
    numbers = distances(template, posed, body)
    iou = silhouette_ious(take, frame, template.vertices, template.faces)
    numbers["silhouette_iou"] = float(np.mean(list(iou.values())))
    overlay = overlay_picture(take, frame, posed, body.faces, alignment.inside)
    poses, rows = _all_training_poses(capture, take)
    return Registered(
        template,
        poses,
        frame,
        take.name,
        source.template,
        alignment.inside,
        overlay,
        {
            "convention": alignment.convention,
            "tried": alignment.tried,
            "inside": alignment.inside,
            "covered": alignment.covered,
            "silhouette_iou_of_template": iou,
            "frames_checked": list(alignment.frames),
            "rows_of_takes": rows,
            "template": how,
            "fit": told
            | {
                "parameters": config.poses if source.fits_body else "given",
                "converted_takes": sorted(source.converted),
            },
            "body": {"vertices": len(body.template_vertices), "digest": body.digest},
            **numbers,
        },
        {"mean_inside": alignment.mean_inside, **numbers},
        fitted,
    )


def alignment_bar(config: RegisterTemplateConfig, fitted: bool) -> float:
    """Least share of the body inside the masks. A fitted body belongs to its cameras, and its masks may be
    ragged, so less is asked of it than of poses that came with the capture."""
    return min(config.bar, _FITTED_BAR) if fitted else config.bar


def _fit(
    source: Source, capture: Capture, take: Take, config: RegisterTemplateConfig, report: Report
) -> tuple[dict[str, Poses], dict[str, Any]]:
    """Fitted poses of all takes, or of those that have none; the take of the template decides the shape."""
    scan = None  # a template that is not the scan asks for the pictures alone
    if source.template == "scan" and take.scan is not None and take.scan_frame in take.frames:
        given = take.read_scan()
        assert given is not None
        scan = clean_scan(given, config.most_faces, str(take.scan), report).mesh
    takes = [take, *(one for one in capture.takes if one.name != take.name)]
    if config.poses == "fit":
        takes = [replace(one, posed=False) for one in takes]
    found = fit_takes(source.body, takes, scan, report, config.effort)
    return found.poses, found.told


def _all_training_poses(capture: Capture, take: Take) -> tuple[Poses, dict[str, list[int]]]:
    """Poses of all training takes, the template's take first, and each take's rows [first, count]."""
    takes = [take, *(other for other in capture.training_takes if other.name != take.name)]
    rows: dict[str, list[int]] = {}
    first = 0
    for one in takes:
        rows[one.name] = [first, len(one.poses)]
        first += len(one.poses)
    together = Poses(
        np.concatenate([one.poses.rotations for one in takes]),
        np.concatenate([one.poses.translation for one in takes]),
        take.poses.betas,
        np.concatenate([one.poses.expression for one in takes]),
        take.fps,
    )
    return together, rows
