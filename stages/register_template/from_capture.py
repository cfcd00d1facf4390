"""Registration of a capture: body and masks checked or fitted, the dressed surface of one frame made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.fitting.body_parts import parts_far_from
from stages.register_template.fitting.fit_capture import fit_takes
from stages.register_template.frame_choice import MERGED_M, choose_frame, openness
from stages.register_template.scan_cleaning import clean_scan
from stages.register_template.sources import Registration, Source, frames_checked
from stages.register_template.surface import distances, make_surface
from stages.shared.body import Poses
from stages.shared.body.posed import posed_body
from stages.shared.capture import Capture, Take
from stages.shared.capture.alignment import check_alignment, overlay_picture, silhouette_ious
from stages.shared.capture.convention import AS_IS, take_in_convention
from stages.shared.capture.open_capture import with_poses
from stages.shared.capture.scaled_take import picture_scales, scaled_for_texels
from stages.shared.report import Report

_FITTED_BAR = 0.80


def register_capture(source: Source, config: RegisterTemplateConfig, report: Report) -> Registration:
    """Check the alignment and make the template of a capture; fit the body first when that is asked for.

    Raises:
        BadData: body and masks do not fit together; masks or a scan that no surface can be made of.
    """
    capture, take, body = source.capture, source.take, source.body
    assert capture is not None and take is not None
    for note in capture.notes:
        report.say(note)
    fitted = dict(source.converted)
    fit_report: dict[str, Any] = {}
    if source.fits_body:
        poses, fit_report = _fit(source, capture, take, config, report)
        fitted |= poses
        capture = with_poses(capture, poses)
        take = capture.take(take.name)
    wrong = fit_report.get("checks", {}).get(take.name, {}).get("wrong_frames", [])
    right = [number for number in take.frames if number not in wrong] or take.frames
    frame = source.frame if source.frame is not None else choose_frame(body, take.poses, right)
    report.step("projecting the body into the masks")
    checked = {number: posed_body(body, take.poses[number]) for number in frames_checked(take, frame)}
    posed = checked[frame]
    small = reduced_take(take, posed, config)
    alignment = check_alignment(small, checked, body.faces, alignment_bar(config, source.fits_body))
    if alignment.convention != AS_IS:
        report.warn(f"camera matrices are read with: {alignment.convention}")
        small = reduced_take(take_in_convention(take, alignment.convention), posed, config)
    for warning in alignment.warnings:
        report.warn(warning)
    report.say(f"{100 * alignment.mean_inside:.1f} % of the body's silhouette lies inside the masks")

    template, making = make_surface(source.template, small, frame, posed, body, config, report)
    if source.fits_body:
        _judge_frame(source, take, frame, right, parts_far_from(template, posed, body), report)
    numbers = distances(template, posed, body)
    iou = silhouette_ious(small, frame, template.vertices, template.faces)
    numbers["silhouette_iou"] = float(np.mean(list(iou.values())))
    overlay = overlay_picture(small, frame, posed, body.faces, alignment.inside)
    poses_of_all, rows = _all_training_poses(capture, take)
    content = {
        "convention": alignment.convention,
        "tried": alignment.tried,
        "inside": alignment.inside,
        "covered": alignment.covered,
        "silhouette_iou_of_template": iou,
        "frames_checked": list(alignment.frames),
        "rows_of_takes": rows,
        "template": making,
        "fit": fit_report
        | {
            "parameters": config.poses if source.fits_body else "given",
            "converted_takes": sorted(source.converted),
        },
        "body": {"vertices": len(body.template_vertices), "digest": body.digest},
        **numbers,
    }
    numbers = {"mean_inside": alignment.mean_inside, **numbers}
    return Registration(
        template, poses_of_all, frame, take.name, alignment.inside, overlay, content, numbers, fitted
    )


def _judge_frame(
    source: Source, take: Take, frame: int, right: Sequence[int], far: list[str], report: Report
) -> None:
    """Say what is wrong with the template's frame, and which other frame is better.

    Arguments:
        right: frames whose fit is right. far: parts of the body that are far from the template.
    """
    scores = openness(source.body, take.poses)
    better = choose_frame(source.body, take.poses, [number for number in right if number != frame] or [frame])
    problems = [f"the {part} of the body is far from the surface" for part in far]
    if scores[frame] < MERGED_M:
        problems.append("arms or legs touch each other or the trunk, and their surfaces are one")
    if frame not in right:
        problems.append("the body does not fit")
    if not problems:
        return
    cure = "take or record a frame with the arms away from the trunk and the legs apart"
    if better != frame and (frame not in right or far or scores[better] > scores[frame]):
        cure = f"--frame {better} is better"
    report.warn(f"{take.name}, frame {frame} of the template: {'; '.join(problems)}; {cure}")


def reduced_take(take: Take, posed: NDArray[np.float64], config: RegisterTemplateConfig) -> Take:
    """The take with pictures of the detail that the hull's grid can show; body (V, 3), world, metres."""
    return scaled_for_texels(take, posed.mean(axis=0), config.hull_pitch_m, config.picture_scale)


def picture_scales_of(source: Source, config: RegisterTemplateConfig) -> list[float] | None:
    """Smallest and largest factor by which pictures are reduced; None before a fit, and for a lone mesh."""
    if source.take is None or source.frame is None or not source.take.posed:
        return None
    posed = posed_body(source.body, source.take.poses[source.frame])
    return picture_scales(reduced_take(source.take, posed, config))


def alignment_bar(config: RegisterTemplateConfig, fitted: bool) -> float:
    """Smallest share of the body that must lie inside the masks.

    It is lower for a fitted body: the fit used these cameras, and the masks may be ragged.
    """
    return min(config.bar, _FITTED_BAR) if fitted else config.bar


def _fit(
    source: Source, capture: Capture, take: Take, config: RegisterTemplateConfig, report: Report
) -> tuple[dict[str, Poses], dict[str, Any]]:
    """Fitted poses of all takes, or of those that have none; the take of the template decides the shape."""
    scan = None  # only a template made of the scan uses the scan in the fit
    if source.template == "scan" and take.scan is not None and take.scan_frame in take.frames:
        mesh = take.read_scan()
        assert mesh is not None
        scan = clean_scan(mesh, config.most_faces, str(take.scan), report).mesh
    takes = [take, *(one for one in capture.takes if one.name != take.name)]
    if config.poses == "fit":
        takes = [replace(one, posed=False) for one in takes]
    fit = fit_takes(source.body, takes, scan, report, config.effort)
    return fit.poses, fit.report


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
