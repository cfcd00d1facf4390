"""How good a capture's template is: body fit, canonical space, labels, maps, skinning, against the truth.

Reads:
    a capture in any layout; the truth that it carries: body parameters, scan labels, test takes
Writes, into the output folder:
    subject/             the workspace that the four geometry commands made
    fit_scan/            a workspace of the first scan alone, its body fitted without parameters
    bench_templates.json {"rows": [{"item", "name", "value", "bar", "met", "note"}], "stages": …, "frames": …}
    table.md             the rows as a table

Every command is a child process; its time is the stage's own (the run record), its memory the process's.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.pipeline import BAKE_MAPS, CANONICALIZE, REGISTER_TEMPLATE, SEGMENT_LAYERS
from stages.shared.artifacts import Artifact, Workspace, write_whole
from stages.shared.artifacts.canonical import readable_json
from stages.shared.body.model import BodyModel
from stages.shared.capture import Capture, Take
from stages.shared.capture.native_writer import native_writer
from stages.shared.capture.outlines import filmed_frames, outline_agreement
from stages.shared.capture.subject import open_subject_capture
from stages.shared.layers import BODY
from stages.shared.meshes.ply import encode_ply
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report
from tests.benchmarks.process import run_command
from tests.benchmarks.templates.config import BARS, BenchTemplatesConfig
from tests.benchmarks.templates.skinned import (
    SkinnedLayer,
    joined,
    largest_stretches,
    posed_together,
)
from tests.benchmarks.templates.truth import fit_errors, label_scores, shape_round_trip

RESULT_NAME = "bench_templates.json"
_STAGES = (REGISTER_TEMPLATE, CANONICALIZE, SEGMENT_LAYERS, BAKE_MAPS)
_MET = {True: "yes", False: "**no**", None: "-"}
_OTHER_SHAPE = np.linspace(-2.0, 2.0, 10)


@dataclass(frozen=True)
class Row:
    """One measured number.

    Attributes:
        item: number of the bar's group. name: key of `BARS`, with a layer or stage after a dot where there
            are several. value: None where the capture has no truth for it; then `note` says why.
    """

    item: int
    name: str
    value: float | None
    note: str = ""

    @property
    def bar(self) -> float | None:
        return BARS[self.name.split(".")[0]].value

    @property
    def met(self) -> bool | None:
        return BARS[self.name.split(".")[0]].met(self.value)


@dataclass(frozen=True)
class BenchTemplatesResult:
    """The folder, and the rows."""

    path: Path
    summary: dict[str, Any]


def run(
    capture: Path,
    output: Path,
    config: BenchTemplatesConfig = BenchTemplatesConfig(),
    report: Report = SILENT,
    body_model: Path | None = None,
) -> BenchTemplatesResult:
    """Make the capture's template and measure it; `body_model` as for `gw register-template`.

    Raises:
        CommandFailed: one of the commands failed.
    """
    subject = output / "subject"
    costs = _make(capture, subject, config, report, body_model)
    workspace = Workspace(subject)
    body = BodyModel.from_arrays(workspace.require(REGISTER_TEMPLATE).arrays("body"))
    opened = open_subject_capture(workspace, body)
    rows = _fit_rows(workspace, opened, body, output, config, report)
    rows += _residual_rows(workspace) + _label_rows(workspace) + _map_rows(workspace)
    skinned, frames = _skinned_rows(workspace, opened, body, config, report)
    rows += skinned + _cost_rows(costs)
    summary = {
        "rows": [{**asdict(row), "bar": row.bar, "met": row.met} for row in rows],
        "met": sum(row.met is True for row in rows),
        "missed": [row.name for row in rows if row.met is False],
        "stages": costs,
        "frames": frames,
    }
    write_whole(output / RESULT_NAME, readable_json(summary))
    write_whole(output / "table.md", _table(rows).encode())
    return BenchTemplatesResult(output, summary)


def _make(
    capture: Path, subject: Path, config: BenchTemplatesConfig, report: Report, body_model: Path | None
) -> dict[str, dict[str, float]]:
    """Run the four commands where they are not done; seconds and peak bytes of each, from its run record."""
    preset = ("--preset", config.preset)
    given = () if body_model is None else ("--body-model", body_model)
    costs = {}
    for spec in _STAGES:
        report.step(f"gw {spec.name}")
        first = (capture, "-o", subject, *given) if spec is REGISTER_TEMPLATE else (subject,)
        run_command(spec.name, *first, *preset)
        record = Workspace(subject).require(spec).run
        costs[spec.name] = {"seconds": record["seconds"], "peak_bytes": record["peak_bytes"]}
    return costs


def _fit_rows(
    workspace: Workspace,
    capture: Capture,
    body: BodyModel,
    output: Path,
    config: BenchTemplatesConfig,
    report: Report,
) -> list[Row]:
    """Fit the body to the scan alone, and to one frame's pictures; compare with the given parameters."""
    names = ("fit_scan_joint_error_mm", "fit_scan_shape_error_mm")
    registered = workspace.require(REGISTER_TEMPLATE)
    take = capture.take(str(registered.summary["take"]))
    images = _images_row(registered, take, body, output, config, report)
    scan = take.read_scan() if config.fit else None
    if scan is None:
        why = "the capture has no scan" if config.fit else "left out"
        return [*(Row(1, name, None, why) for name in names), images]
    report.step("fitting the body to the scan alone")
    write_whole(output / "scan.ply", encode_ply(scan))
    run_command(
        "register-template", output / "scan.ply", "-o", output / "fit_scan", "--body-model",
        registered.file("body.safetensors"), "--preset", config.preset,
    )  # fmt: skip
    fitted = load_poses(Workspace(output / "fit_scan").require(REGISTER_TEMPLATE).file("smpl_params.npz"))
    joint, shape = fit_errors(body, fitted, take.poses, take.scan_frame or 0)
    return [Row(1, names[0], 1e3 * joint), Row(1, names[1], 1e3 * shape), images]


def _images_row(
    registered: Artifact,
    take: Take,
    body: BodyModel,
    output: Path,
    config: BenchTemplatesConfig,
    report: Report,
) -> Row:
    """Joint error of a fit to the pictures of the template's frame: a capture of its own, without poses."""
    name, frame = "fit_images_joint_error_mm", int(registered.summary["frame"])
    if not config.fit:
        return Row(1, name, None, "left out")
    report.step("fitting the body to pictures alone")
    seeing = [take.camera(camera) for camera in take.training_cameras if take.has_image(camera, frame)]
    with native_writer(output / "one_frame", seeing) as writer:
        views = writer.take(take.name, "train", None)
        for camera in seeing:
            picture, mask = take.image(camera.name, frame), take.mask(camera.name, frame)
            views.view(camera.name, 0, picture, mask, take.labels(camera.name, frame), jpeg=False)
    run_command(
        "register-template", output / "one_frame", "-o", output / "fit_images", "--fit", "--template", "hull",
        "--body-model", registered.file("body.safetensors"), "--preset", config.preset,
    )  # fmt: skip
    fitted = load_poses(Workspace(output / "fit_images").require(REGISTER_TEMPLATE).file("smpl_params.npz"))
    joint, shape = fit_errors(body, fitted, take.poses, frame)
    return Row(1, name, 1e3 * joint, f"shape {1e3 * shape:.1f} mm; {len(seeing)} cameras")


def _residual_rows(workspace: Workspace) -> list[Row]:
    summary = workspace.require(CANONICALIZE).summary
    segmented = workspace.require(SEGMENT_LAYERS)
    garments = [name for name in segmented.summary["layers"] if name != BODY]
    trips = [shape_round_trip(segmented, name, _OTHER_SHAPE) for name in garments]
    return [
        Row(2, "pose_back_max_m", summary["residual_max_m"]),
        Row(2, "pose_back_requeried_p95_m", summary["requeried_residual_p95_m"]),
        Row(2, "shape_transfer_max_m", max(trips, default=None), "" if trips else "no garment"),
    ]


def _label_rows(workspace: Workspace) -> list[Row]:
    segmented = workspace.require(SEGMENT_LAYERS)
    template = workspace.require(REGISTER_TEMPLATE).arrays("template")
    note = ""
    if "labels" not in template:
        note = "the scan has no labels"
    elif segmented.summary["labels_from"] != "images":
        note = "the labels were taken from the truth itself"
    scores: dict[str, float | None] = {"accuracy": None, "miou": None}
    if not note:
        scores = label_scores(segmented.arrays("labels")["labels"], template["labels"])
    return [Row(3, f"label_{name}", scores[name], note) for name in ("accuracy", "miou")]


def _map_rows(workspace: Workspace) -> list[Row]:
    summary = workspace.require(BAKE_MAPS).summary
    before = summary["unseen_area_two_views"]
    rows = [
        Row(4, f"unseen_area.{name}", share, f"{before[name]:.4f} without peeled sheets")
        for name, share in summary["unseen_area"].items()
    ]
    note = f"stored: {summary['texels_of_full_maps']:.3f}; {sum(summary['texels'].values())} texels"
    return [*rows, Row(4, "windows_of_full_maps", summary["windows_of_full_maps"], note)]


def _skinned_rows(
    workspace: Workspace, capture: Capture, body: BodyModel, config: BenchTemplatesConfig, report: Report
) -> tuple[list[Row], dict[str, float]]:
    """Silhouettes and stretch over the test takes, and the IoU of every frame."""
    if not capture.test_takes:
        why = "the capture has no test take"
        return [Row(5, "skinned_iou", None, why), Row(5, "stretch", None, why)], {}
    report.step("moving the layers by their bones")
    segmented = workspace.require(SEGMENT_LAYERS)
    layers = {name: SkinnedLayer.load(segmented, name) for name in segmented.summary["layers"]}
    garments = {name: layer for name, layer in layers.items() if name != BODY}
    frames: dict[str, float] = {}
    stretches: dict[str, float] = {}
    for take in capture.test_takes:
        cameras = list(take.training_cameras[:: config.camera_step])
        chosen = filmed_frames(take)[:: config.frame_step]
        found = outline_agreement(posed_together(layers, body, take), joined(layers), take, chosen, cameras)
        frames |= {f"{take.name} {frame}": score for frame, score in found.items()}
        for name, growth in largest_stretches(garments, body, take).items():
            stretches[name] = max(growth, stretches.get(name, 0.0))
    rows = [Row(5, "skinned_iou", float(np.mean(list(frames.values()))), f"{len(frames)} frames")]
    for name, growth in stretches.items():
        rows.append(Row(5, f"{'stretch' if name == 'lower' else 'other_stretch'}.{name}", growth))
    return rows, frames


def _cost_rows(costs: dict[str, dict[str, float]]) -> list[Row]:
    rows = []
    for name, cost in costs.items():
        rows += [Row(6, f"stage_seconds.{name}", cost["seconds"])]
        rows += [Row(6, f"stage_peak_bytes.{name}", cost["peak_bytes"])]
    return rows


def _table(rows: list[Row]) -> str:
    lines = ["| item | row | value | bar | met | note |", "| --- | --- | --- | --- | --- | --- |"]
    for row in rows:
        value = "-" if row.value is None else f"{row.value:.4g}"
        bar = "-"
        if row.bar is not None:
            bar = f"{'≤' if BARS[row.name.split('.')[0]].kind == 'max' else '≥'} {row.bar:g}"
        lines.append(f"| {row.item} | {row.name} | {value} | {bar} | {_MET[row.met]} | {row.note} |")
    return "\n".join(lines) + "\n"
