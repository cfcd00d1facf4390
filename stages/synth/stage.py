"""`gw synth`: two synthetic people in multi-view video, and the truth of one wearing the other's skirt.

Reads nothing. Writes, under the output folder:
    subject_1, subject_2   native captures with the takes `train` and `held_out` (images, masks, labels, exact
                           `smpl_params.npz`, `scan.ply` of frame 0, `gt/meshes.npz` simulated garments)
    tryon_truth            native capture, take `held_out` (split test): subject 2 in subject 1's skirt
    inner_truth            native capture, take `inner` (split test): some training frames of subject 2
                           without the vest; the shirt is where it was under the vest
    motions/held_out.npz   the poses of that take, 30 frames/s, layout of `smpl_params.npz`
    motions/showcase.npz   7 seconds for films, subject 2's shape: a walk with a turn, arms raised, a twist
World: metres, y up, the floor is y = 0. All poses are at 30 frames/s; every few frames have images.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.files import require_room, write_whole
from stages.shared.body import Poses, embedded_body
from stages.shared.capture import native_writer
from stages.shared.errors import UsageProblem
from stages.shared.meshes import edges
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_folder_target
from stages.synth import motion
from stages.synth.bodies import PERSON_1, PERSON_2, Person, ShapedBody, betas_of
from stages.synth.config import SynthConfig
from stages.synth.dressed import Bound, accessories, look_of, vertices_at
from stages.synth.garments import LOWER, OUTER, Garment, Pattern, fit, wardrobe
from stages.synth.simulate import simulate
from stages.synth.truth import garment_truth, scan
from stages.synth.views import Scene, camera_ring

WORKERS = max(1, min(8, os.cpu_count() or 1))
TRAIN, HELD_OUT, INNER = "train", "held_out", "inner"
CAPTURES = ("subject_1", "subject_2", "tryon_truth", "inner_truth")
SOURCE = "gw synth"  # what a capture says about where it is from


@dataclass(frozen=True)
class SynthResult:
    """Where the captures are, and a few numbers to judge them by."""

    captures: dict[str, Path]
    motion: Path
    summary: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Outfit:
    """One person with hair and shoes in a set of garments, inner layer first."""

    person: Person
    body: ShapedBody
    bound: list[Bound]
    garments: list[Garment]


Job = tuple[str, str, Outfit]  # capture, take, who wears what


@dataclass(frozen=True, eq=False)
class Take:
    """An outfit in a motion: T frames of poses and cloth, and the frames that get images."""

    capture: str
    name: str
    outfit: Outfit
    poses: Poses
    frames: list[int]
    cloth: list[NDArray[np.float32]]


def plan(output: Path, config: SynthConfig = SynthConfig()) -> Plan:
    """What `run` would write and cost."""
    check_places(output)
    views = _views(config)
    rays = views * (config.image_size * config.supersample) ** 2
    frames = 2 * config.train_images * config.train_stride + 3 * config.test_images * config.test_stride
    cloth = frames * 8e-7 / config.cloth_spacing**2 * config.substeps  # seconds of one core
    pictures = 5e-8 * rays + 0.03 * views
    return Plan(
        inputs=[],
        outputs=[f"{output}/{name}" for name in (*CAPTURES, "motions/held_out.npz", "motions/showcase.npz")],
        config=asdict(config),
        seconds=10 + (cloth + pictures) / 2,
        memory_bytes=900 << 20,
        disk_bytes=_disk_bytes(config),
    )


def _views(config: SynthConfig) -> int:
    """Pictures of all captures."""
    return (2 * config.train_images + 4 * config.test_images) * (config.cameras + 1)


def _disk_bytes(config: SynthConfig) -> int:
    """Estimate of what `run` writes."""
    return int(_views(config) * (4000 + 0.22 * config.image_size**2)) + (12 << 20)


def run(output: Path, config: SynthConfig = SynthConfig(), report: Report = SILENT) -> SynthResult:
    """Make both captures and the truth of the try-on (see the module's text).

    Raises:
        UsageProblem: something else stands where the captures go. StorageFailure: disk full, no permission.
    """
    check_places(output)
    require_room(output, _disk_bytes(config))
    report.step("cutting garments")
    mean = ShapedBody(embedded_body(), np.zeros(10, dtype=np.float32))
    first, second, swapped = outfits(mean, config)

    report.step("simulating cloth")
    jobs = [
        ("subject_1", TRAIN, first),
        ("subject_1", HELD_OUT, first),
        ("subject_2", TRAIN, second),
        ("subject_2", HELD_OUT, second),
        ("tryon_truth", HELD_OUT, swapped),
    ]
    takes = _parallel(lambda job: _simulated(job, config), sorted(jobs, key=_longest_first), report)

    takes.append(_without_outer(takes, config))

    report.step("rendering views")
    captures = {}
    for capture in CAPTURES:
        captures[capture] = output / capture
        shown = [take for take in takes if take.capture == capture]
        _write_capture(captures[capture], sorted(shown, key=lambda take: take.name != TRAIN), config, report)

    tryon = next(take for take in takes if take.capture == "tryon_truth")
    motion_path = output / "motions" / "held_out.npz"
    write_whole(motion_path, tryon.poses.to_npz_bytes())
    showcase = motion.poses_of(
        motion.showcase_motion, round(motion.SHOWCASE_SECONDS * motion.FPS), second.body
    )
    write_whole(output / "motions" / "showcase.npz", showcase.to_npz_bytes())
    return SynthResult(captures, motion_path, _summary(takes, config))


def check_places(output: Path) -> None:
    """Raise UsageProblem where a capture would take the place of something that this command did not make."""
    check_folder_target(output)
    for name in CAPTURES:
        folder = output / name
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            continue
        try:
            ours = json.loads((folder / "capture.json").read_bytes())["about"]["source"] == SOURCE
        except (OSError, ValueError, KeyError, TypeError):
            ours = False
        if not ours:
            raise UsageProblem(
                "Something else than a synthetic capture stands there, which would be lost.",
                str(folder),
                "Give a new or an empty folder.",
            )


def outfits(mean: ShapedBody, config: SynthConfig) -> tuple[Outfit, Outfit, Outfit]:
    """Subject 1, subject 2, and subject 2 with subject 1's skirt in place of its trousers."""
    patterns_1, patterns_2 = wardrobe(mean, config.cloth_spacing, config.seed)
    spacing = float(np.clip(0.6 * config.cloth_spacing, 0.008, 0.016))

    def dressed(person: Person, patterns: list[Pattern]) -> Outfit:
        body = ShapedBody(mean.model, betas_of(mean.model, person))
        bound = accessories(mean, body, person, spacing)
        return Outfit(person, body, bound, [fit(pattern, mean, body) for pattern in patterns])

    first, second = dressed(PERSON_1, patterns_1), dressed(PERSON_2, patterns_2)
    skirt = fit(next(pattern for pattern in patterns_1 if pattern.label == LOWER), mean, second.body)
    # The vest stays on: no camera saw the shirt beneath it, so it cannot be learned.
    others = [garment for garment in second.garments if garment.label != LOWER]
    return first, second, replace(second, garments=[skirt, *others])


def _without_outer(takes: list[Take], config: SynthConfig) -> Take:
    """Some training frames of subject 2, as many as a test has, without the outer garment."""
    take = next(one for one in takes if (one.capture, one.name) == ("subject_2", TRAIN))
    inner = [index for index, garment in enumerate(take.outfit.garments) if garment.label != OUTER]
    outfit = replace(take.outfit, garments=[take.outfit.garments[index] for index in inner])
    rows = np.linspace(0, len(take.frames) - 1, config.test_images).round().astype(int)
    frames = [take.frames[row] for row in np.unique(rows)]
    cloth = [take.cloth[index] for index in inner]
    return Take("inner_truth", INNER, outfit, take.poses, frames, cloth)


def _simulated(job: Job, config: SynthConfig) -> Take:
    capture, name, outfit = job
    training = name == TRAIN
    images = config.train_images if training else config.test_images
    stride = config.train_stride if training else config.test_stride
    # Training starts with the clean A-pose; the held-out take leaves that pose out.
    frames = [stride * index + (0 if training else stride - 1) for index in range(images)]
    moves = motion.training_motion if training else motion.held_out_motion
    poses = motion.poses_of(moves, images * stride, outfit.body)
    cloth = simulate(outfit.body, outfit.garments, poses, motion.FPS * config.substeps)
    return Take(capture, name, outfit, poses, frames, cloth)


def _write_capture(path: Path, takes: list[Take], config: SynthConfig, report: Report) -> None:
    """One native capture, whole or absent."""
    cameras, held_out = camera_ring(config.cameras, config.image_size)
    outfit = takes[0].outfit
    look = look_of(outfit.body, outfit.person, outfit.bound, outfit.garments)
    with native_writer(path, cameras, [held_out]) as writer:
        writer.notes.update(_about(outfit, config))
        for take in takes:
            folder = writer.take(
                take.name, "train" if take.name == TRAIN else "test", take.poses, take.frames[0]
            )
            folder.extra("gt/meshes.npz", garment_truth(outfit.garments, take.cloth, take.frames))
            if take.name == TRAIN:
                folder.scan(
                    scan(look, vertices_at(take.frames[0], outfit.body, take.poses, outfit.bound, take.cloth))
                )

            def render(frame: int, take: Take = take, folder: Any = folder) -> None:
                vertices = vertices_at(frame, outfit.body, take.poses, outfit.bound, take.cloth)
                scene = Scene(look, vertices, config.ambient_rays, config.seed)
                for camera in cameras:
                    view = scene.picture(camera, config.supersample)
                    folder.view(camera.name, frame, view.image, view.mask, view.labels, jpeg=config.jpeg)

            _parallel(render, take.frames, report)


def _parallel(work: Callable[[Any], Any], items: list[Any], report: Report) -> list[Any]:
    """Results in the order of the items; the compiled work runs outside the interpreter lock."""
    results = []
    with ThreadPoolExecutor(WORKERS) as pool:
        for done, result in enumerate(pool.map(work, items), start=1):
            results.append(result)
            report.progress(done, len(items))
    return results


def _longest_first(job: Job) -> tuple[bool, int]:
    return job[1] != TRAIN, -len(job[2].garments)


def _about(outfit: Outfit, config: SynthConfig) -> dict[str, Any]:
    return {
        "source": SOURCE,
        "body_model_digest": outfit.body.model.digest,
        "garments": {garment.layer: garment.name for garment in outfit.garments},
        "config": asdict(config),
    }


def _summary(takes: list[Take], config: SynthConfig) -> dict[str, Any]:
    stretches = []
    for take in takes:
        for garment, positions in zip(take.outfit.garments, take.cloth, strict=True):
            ends = edges(garment.faces).T
            stretches.append(_lengths(positions[take.frames], *ends) / _lengths(garment.vertices, *ends))
    count = {take.capture + "/" + take.name: len(take.frames) for take in takes}
    return {
        "frames": count,
        "views": sum(count.values()) * (config.cameras + 1),
        "image_size": config.image_size,
        "cloth_vertices": {
            f"{take.capture} {garment.layer}": len(garment.vertices)
            for take in takes
            for garment in take.outfit.garments
            if take.name == HELD_OUT
        },
        "stretch_99_percent": float(np.percentile(np.concatenate([one.ravel() for one in stretches]), 99)),
    }


def _lengths(points: NDArray, starts: NDArray, ends: NDArray) -> NDArray:
    """(..., E) metres between vertices of (..., V, 3)."""
    return np.asarray(np.linalg.norm(points[..., starts, :] - points[..., ends, :], axis=-1))
