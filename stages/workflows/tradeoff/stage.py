"""Measure quality, speed and size for pitches and decoders of one capture.

Reads:
    a capture (as `gw register-template` does).
Writes, into the output folder:
    subject/: the workspace of all trainings. points/NAME/: bundles of an operating point, its evaluation.
    tradeoff.json: every point; tradeoff.html, tradeoff.png, table.md: the picture and the table.

Every step is a `gw` command in its own process. Finished steps are not repeated.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stages.shared.artifacts import write_whole
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.pictures import encode_png
from stages.shared.charts import check_charts
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.input_files import read_json_object
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_folder_target
from stages.workflows.command import RunCommand
from stages.workflows.tradeoff.config import AS_TRAINED, BenchTradeoffConfig, Decoder, Training
from stages.workflows.tradeoff.figure import markdown, tradeoff_page, tradeoff_picture
from stages.workflows.tradeoff.front import OperatingPoint, on_front

RESULT_NAME = "tradeoff.json"
_NO_LIMIT = 1_000_000  # steps; the minutes end a training
_SCORES = ("psnr_foreground", "ssim_foreground", "miou", "sharpness")


@dataclass(frozen=True)
class BenchTradeoffResult:
    """The output folder and the measured points."""

    path: Path
    summary: dict[str, Any]


def run(
    capture: Path,
    output: Path,
    config: BenchTradeoffConfig,
    run_command: RunCommand,
    report: Report = SILENT,
    body_model: Path | None = None,
) -> BenchTradeoffResult:
    """Train at every pitch, play with every decoder, and draw the results.

    Raises:
        UsageProblem: nothing to measure. GwError: a command failed.
    """
    _check(output, config)
    capture, output = capture.resolve(), output.resolve()
    subject = output / "subject"
    report.step("template")
    run_command(*_registration(capture, subject, body_model))
    for command in ("canonicalize", "segment-layers"):
        run_command(command, subject, "--preset", config.preset)
    points: list[OperatingPoint] = []
    played = [(training, config.decoders) for training in config.trainings]
    played += [(training, (AS_TRAINED,)) for training in config.also]
    for training, decoders in played:
        report.step(f"{training.preset}: training for {training.minutes:g} minutes")
        layers, pitch = _train(run_command, subject, training, config)
        for decoder in sorted(decoders, key=lambda decoder: decoder.trained):
            if decoder.trained:  # last, because what is distilled is the latest training
                _train(run_command, subject, training, config, decoder)
            point = _name(training, pitch, decoder, config)
            report.step(point)
            points.append(
                _measure(run_command, subject, output, point, pitch, decoder, layers, training, config)
            )
            report.say(f"{points[-1].frames_per_second:.1f} frames/s, {points[-1].psnr_foreground:.2f} dB")
            write_results(output, capture.name, points, config)
    return BenchTradeoffResult(output, json.loads((output / RESULT_NAME).read_bytes()))


def plan(
    capture: Path,
    output: Path,
    config: BenchTradeoffConfig,
    run_command: RunCommand,
    body_model: Path | None = None,
) -> Plan:
    """The cost of `run`. Measuring a point counts as one minute."""
    _check(output, config)
    subject = output.resolve() / "subject"
    run_command(*_registration(capture.resolve(), subject, body_model), "--dry-run")
    points = len(config.pitches) * len(config.decoders) + len(config.also)
    minutes = config.minutes + sum(training.minutes for training in config.also)
    return Plan(
        inputs=[str(capture)],
        outputs=[str(output / name) for name in (RESULT_NAME, "tradeoff.html", "tradeoff.png", "table.md")],
        config=asdict(config),
        seconds=60.0 * (minutes + points),
        memory_bytes=2_000_000_000,
        disk_bytes=points * 60_000_000,
    )


def _check(output: Path, config: BenchTradeoffConfig) -> None:
    """Raise UsageProblem for what cannot be measured or written, MissingInput without matplotlib."""
    if not config.pitches or not config.decoders or config.minutes <= 0 or min(config.pitches) <= 0:
        raise UsageProblem("There is nothing to measure.", "options", "Give minutes and pitches.")
    check_charts()
    check_folder_target(output)


def _registration(capture: Path, subject: Path, body_model: Path | None) -> list[str | Path]:
    """The first command of the bench."""
    model: list[str | Path] = ["--body-model", body_model.resolve()] if body_model else []
    return ["register-template", capture, "-o", subject, *model]


def read_points(folder: Path) -> list[OperatingPoint]:
    """The points that a bench wrote to its folder.

    Raises:
        MissingInput: there are no points. BadData: they cannot be read.
    """
    path = folder / RESULT_NAME
    if not path.is_file():
        raise MissingInput("There are no measured operating points.", str(path), "Run gw bench tradeoff.")
    content = read_json_object(path, "operating points").get("points")
    if not isinstance(content, list) or not content:
        raise BadData("The file has no points.", str(path), "Run gw bench tradeoff again.")
    return [OperatingPoint.from_dict(point, str(path)) for point in content]


def bundles_of(folder: Path, point: OperatingPoint) -> list[Path]:
    """The bundle files of a point.

    Raises:
        MissingInput: a file does not exist.
    """
    bundles = sorted((folder / "points" / point.name).glob("*.gwg"))
    if not bundles:
        raise MissingInput(
            f"The bundles of the operating point {point.name} are gone.",
            str(folder / "points" / point.name),
            "Run gw bench tradeoff again with this folder as -o.",
        )
    return bundles


def _train(
    run_command: RunCommand,
    subject: Path,
    training: Training,
    config: BenchTradeoffConfig,
    decoder: Decoder = AS_TRAINED,
) -> tuple[list[str], float]:
    """Bake and train. Returns the layers and the pitch in mm per texel."""
    fine = ["--pitch", f"{training.pitch:g}"] if training.pitch else []
    baked = run_command("bake-maps", subject, "--preset", training.preset, *fine)
    kind = ["--decoder", "blendshapes", "--ranks", _text(decoder.ranks)] if decoder.trained else []
    limits = ["--minutes", f"{training.minutes:g}", "--steps", str(_NO_LIMIT), "--seed", str(config.seed)]
    trained = run_command("train", subject, "--preset", training.preset, *limits, *kind)
    return list(trained.result["layers"]), 1000.0 * float(baked.result["pitch"])


def _name(training: Training, pitch: float, decoder: Decoder, config: BenchTradeoffConfig) -> str:
    """Name of a point and of its folder."""
    whole = "" if training in config.trainings else f"{training.preset} "
    return f"{whole}{pitch:g} mm {decoder.name}".replace(" ", "-")


def _text(ranks: tuple[int, int, int] | None) -> str:
    return ",".join(str(rank) for rank in ranks or ())


def _measure(
    run_command: RunCommand,
    subject: Path,
    output: Path,
    name: str,
    pitch: float,
    decoder: Decoder,
    layers: Sequence[str],
    training: Training,
    config: BenchTradeoffConfig,
) -> OperatingPoint:
    """Export, play and score one point."""
    folder, distilled = output / "points" / name, decoder.ranks is not None and not decoder.trained
    folder.mkdir(parents=True, exist_ok=True)
    if distilled:
        run_command("distill", subject, "--preset", training.preset, "--ranks", _text(decoder.ranks))
    bundles = [folder / f"{layer}.gwg" for layer in layers]
    for layer, bundle in zip(layers, bundles, strict=True):
        flags = ["--distilled"] if distilled else []
        run_command("export-garment", subject, "--layer", layer, *flags, "-o", bundle)
    played = run_command(
        "bench", "playback", *bundles, "--poses", subject / "smpl_params.npz",
        "--size", str(config.size), "--frames", str(config.frames),
    )  # fmt: skip
    method = "distilled" if distilled else "trained"
    scored = run_command(
        "evaluate", subject, "-o", folder / "evaluation", "--methods", method,
        "--frame-step", str(config.frame_step), "--test-frame-step", str(config.test_frame_step),
    )  # fmt: skip
    views = {split: scored.result[split][method] for split in ("novel_view", "novel_pose")}
    return OperatingPoint(
        name=name,
        pitch=pitch,
        decoder=decoder.name,
        gaussians=played.result["gaussians"],
        **{score: views["novel_view"][score] for score in _SCORES},
        novel_pose={score: views["novel_pose"][score] for score in _SCORES},
        frames_per_second=played.result["frames_per_second"],
        training_minutes=training.minutes,
        bundle_bytes=sum(bundle.stat().st_size for bundle in bundles),
        peak_bytes=played.peak_bytes,
    )


def write_results(
    output: Path, subject: str, points: Sequence[OperatingPoint], config: BenchTradeoffConfig
) -> None:
    """Write all results so far, so that an interrupted bench keeps them."""
    front = on_front(points)
    content = {
        "format": "gw-tradeoff",
        "version": 1,
        "config": asdict(config),
        "points": [{**point.as_dict(), "on_front": point in front} for point in points],
    }
    write_whole(output / RESULT_NAME, readable_json(content))
    write_whole(output / "table.md", markdown(points, front).encode())
    write_whole(
        output / "tradeoff.html", tradeoff_page(points, front, f"Speed for accuracy: {subject}").encode()
    )
    write_whole(output / "tradeoff.png", encode_png(tradeoff_picture(points, front)))
