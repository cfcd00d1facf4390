"""From the configuration as given to the one that a run uses: resolved once, before anything is built."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from stages.shared.avatar.config import NETWORKS
from stages.shared.avatar.decoders.registry import decoder_class
from stages.shared.body import posed_vertices
from stages.shared.body.posed import pose_tensors
from stages.shared.errors import UsageProblem
from stages.train.config import PRESETS, TrainConfig, apply_ablation
from stages.train.estimate import SECONDS_PER_TRACKED_VIEW
from stages.train.methods import method_called
from stages.train.random_crop import SMALLEST
from stages.train.source import Source
from stages.train.take_sequence import TakeSequence

_TRACKING_SHARE = 1 / 3  # of `minutes`
_FRAMES_BY_TIME = 40  # frames of a take that presets without a step learn from
_LONGEST_GAP = 0.5  # s between two of them
_PIXELS_PER_TEXEL = 2.5  # that warm-up and tracking look at


def resolve(config: TrainConfig, source: Source) -> TrainConfig:
    """The configuration that a run uses.

    Method, decoder and ablation are applied. `frame_step` follows from the take where it is 0, `track.scale`
    from the size of a texel. `track.frame_step` is what the time allows. `model.anchors` is the number of key
    poses. Losses that only a frozen body could answer are off.

    Raises:
        UsageProblem: as `resolve_settings`.
    """
    config = resolve_settings(config)
    if not config.frame_step:
        frames = source.sequence.takes[0].frames
        config = replace(config, frame_step=frame_step_by_time(len(frames), source.poses.fps))
    if not config.track.scale:
        config = replace(config, track=replace(config.track, scale=_scale_of(source)))
    config = affordable_tracking(config, source.sequence)
    config = replace(config, model=replace(config.model, anchors=_key_poses(config, source.sequence)))
    return replace(config, weights=source.warm_start.weights(config.weights))


def smaller_runs(config: TrainConfig, source: Source) -> dict[str, TrainConfig]:
    """Options that may need less memory, mildest first, and the resolved configuration with each."""
    others = {"--recompute": replace(config, recompute=True)}
    for name in ("balanced", "draft", "tiny"):
        preset = replace(PRESETS[name], method=config.method, minutes=config.minutes)
        others[f"--preset {name}"] = resolve(preset, source)
    return others


def resolve_settings(config: TrainConfig) -> TrainConfig:
    """What can be resolved without the capture; applying it twice changes nothing more.

    Raises:
        UsageProblem: unknown method, decoder or part; settings that exclude each other.
    """
    method, decoder = method_called(config.method), decoder_class(config.model.decoder)
    if 0 < config.patch < SMALLEST:
        raise UsageProblem(
            f"A window of {config.patch} px is too small to learn from.",
            "option --patch",
            f"Give at least {SMALLEST}, or 0 for whole pictures.",
        )
    if config.model.networks not in NETWORKS:
        raise UsageProblem(
            f"No layers are called {config.model.networks!r}.",
            "option --networks",
            f"Choose of {', '.join(NETWORKS)}.",
        )
    track = config.track if decoder.followed else replace(config.track, frame_step=0)
    config = replace(config, model=decoder.resolved(config.model), track=track)
    config = apply_ablation(method.resolve(config))
    if not config.model.anchors:  # without key poses there is nothing to track
        config = replace(config, track=replace(config.track, frame_step=0))
    return config


def frame_step_by_time(frames: int, fps: float) -> int:
    """Step between the frames of a take that are learned from: about 40 frames, and all of a short take.

    Long takes give more frames, so that no two are further apart than half a second.

    Arguments:
        frames: number of frames of the take. fps: frames per second.
    """
    return max(1, min(frames // _FRAMES_BY_TIME, int(_LONGEST_GAP * fps)))


def scale_by_texel(focal: float, distance: float, pitch: float) -> float:
    """Size of pictures, at most 1, at which a texel covers two to three pixels.

    Finer pictures would show nothing that the texels could follow.

    Arguments:
        focal: px. distance: m along the camera's axis. pitch: m per texel.
    """
    return min(1.0, _PIXELS_PER_TEXEL / max(focal * pitch / max(distance, 1e-3), 1e-9))


def affordable_tracking(config: TrainConfig, sequence: TakeSequence) -> TrainConfig:
    """The configuration with a step between tracked frames that `minutes` leave time for.

    Tracking may take a third of the run. If it would take longer, only frames that are learned from are
    tracked, or every second of them, and so on. The estimate decides, not the clock, so a run can be
    repeated.
    """
    step, frames = config.track.frame_step, len(sequence.frames)
    if config.minutes <= 0 or not step:
        return config
    cameras = len(sequence.training_cameras)
    most = _TRACKING_SHARE * 60.0 * config.minutes / (cameras * SECONDS_PER_TRACKED_VIEW)
    wider = [config.frame_step * factor for factor in range(1, frames + 1)]
    steps = (step, *(other for other in wider if other > step))
    affordable = next((s for s in steps if math.ceil(frames / s) <= most), 0)
    return replace(config, track=replace(config.track, frame_step=affordable))


def _key_poses(config: TrainConfig, sequence: TakeSequence) -> int:
    """Key poses of every garment: one per tracked frame, else as configured, at most one per frame."""
    if not config.model.anchors:
        return 0
    if config.track.frame_step:
        return len(sequence.every(config.track.frame_step))
    return min(config.model.anchors, len(sequence.every(config.frame_step)))


def _scale_of(source: Source) -> float:
    """`scale_by_texel` of the finest layer in the template's frame: the median of the training cameras."""
    frame = source.template_frame
    vertices = posed_vertices(
        source.body, *pose_tensors(source.poses, frame), torch.from_numpy(source.poses.expression[frame])
    )
    centre = vertices.mean(dim=0).double().numpy()
    pitch = min(maps.pitch for maps in source.layers.maps.values())
    scales = []
    for name in source.sequence.training_cameras:
        camera = source.sequence.camera(name, frame)
        distance = float(camera.camera_from_world[2, :3] @ centre + camera.camera_from_world[2, 3])
        scales.append(scale_by_texel(float(camera.intrinsics[0, 0]), distance, pitch))
    return round(float(np.median(scales)), 3)
