"""Estimates of a run before it starts: time, memory, disk and operations per frame; and the memory guard.

Times are for two CPU cores. Memory is the peak of the process. It is the sum of the libraries, the parameters
(with gradients, both moments of Adam, and a copy while a checkpoint is read or written), the Gaussians of a
step, the decoded and cached pictures, and the larger of the networks' activations and the PCA of positional
maps at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from stages.shared.avatar.decoders.base import DecoderCost
from stages.shared.avatar.decoders.cost import joints_used, multiply_adds
from stages.shared.avatar.decoders.registry import decoder_class
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import pose_at
from stages.shared.avatar.used_joints import GROUPS, describe_rest
from stages.shared.body import BodyModel, Poses
from stages.shared.errors import UsageProblem
from stages.shared.layers import LAYERS
from stages.shared.memory import REFUSED_ABOVE, available_bytes, is_memory_error
from stages.train.config import TrainConfig
from stages.train.distributed import on_this_machine
from stages.train.source import Source
from stages.train.take_sequence import TakeSequence
from stages.train.views import CACHE_BYTES, CACHE_BYTES_PER_PIXEL

# Measured on two cores, forward and backward: per Gaussian and camera and per camera (512² images), per
# Gaussian (deformation and surface terms).
_SECONDS_PER_GAUSSIAN_SEEN = 0.6e-6
_SECONDS_PER_PICTURE = 0.02
_SECONDS_PER_GAUSSIAN = 1.5e-6
SECONDS_PER_TRACKED_VIEW = 0.15  # a frame in one camera, all rounds
# Computed, not measured: VGG-16 forward, backward, and forward for the truth, at 100 GFLOP/s.
_SECONDS_PER_PERCEIVED_PIXEL = 1.8e-5
_FLOAT = 4
_COPIES = 5  # value, gradient, two moments; one more while reading and writing
_LIBRARIES = 540_000_000  # bytes of torch, compiled kernels and the rest, measured
_BYTES_PER_GAUSSIAN = 3000  # maps, and what a step computes from them; measured
_BACKWARD = 1.2  # memory of a backward pass, in units of the activations
_VIEW_FLOATS = 8  # per pixel of a view: colour, three masks, silhouette; layers add a channel each
_RENDER_FLOATS = 75  # per pixel while its picture is drawn and compared
_BYTES_PER_PERCEIVED_PIXEL = 2200  # computed: activations of VGG-16
_PCA_FLOATS = 7  # per value of a positional map in one frame
_OTHER_FILES = 16 << 20  # bytes of metrics and previews
_SAMPLES = 6  # pictures that are measured for `Extent.pixels`
_MOST_POSES = 400  # rows of a take in which joints at rest are looked for


@dataclass(frozen=True)
class Extent:
    """How much of the capture a run reads.

    Attributes:
        learned, followed: number of frames that are learned from, and through which garments are tracked.
        read: number of frames of either kind. cameras: of each. pixels: of a picture cropped to the subject,
            the mean of a few.
    """

    learned: int
    followed: int
    read: int
    cameras: int
    pixels: int

    @property
    def tracked_views(self) -> int:
        """Pictures through which garments are tracked."""
        return self.followed * self.cameras


def extent_of(sequence: TakeSequence, config: TrainConfig) -> Extent:
    """What a run with a resolved configuration reads; views that show nobody count as nothing."""
    cameras = sequence.training_cameras
    learned = sequence.every(config.frame_step)
    followed = sequence.every(config.track.frame_step) if config.track.frame_step else []
    views = [(camera, frame) for frame in learned for camera in cameras]
    boxes = [sequence.subject_box(*view, margin=8) for view in views[:: max(1, len(views) // _SAMPLES)]]
    sizes = [(right - left) * (bottom - top) for left, top, right, bottom in filter(None, boxes)]
    mean = round(sum(sizes) / max(len(sizes), 1))
    return Extent(len(learned), len(followed), len({*learned, *followed}), len(cameras), mean)


def seconds(maps: Mapping[str, LayerMaps], config: TrainConfig, extent: Extent) -> float:
    """Time of a whole run."""
    gaussians = sum(len(layer) for layer in maps.values())
    pictures = config.views_per_step * (gaussians * _SECONDS_PER_GAUSSIAN_SEEN + _SECONDS_PER_PICTURE)
    decoders = gaussians * _SECONDS_PER_GAUSSIAN
    decoders += sum(cost.seconds for cost in _decoder_costs(maps, config))
    perceived = 2 * config.views_per_step * _perceived_pixels(config) * _SECONDS_PER_PERCEIVED_PIXEL
    total = config.steps * (pictures + decoders + perceived)
    if config.track.frame_step:
        total += extent.tracked_views * SECONDS_PER_TRACKED_VIEW + config.track.warm_up * pictures
    return min(total, 60.0 * config.minutes) if config.minutes > 0 else total


def memory_bytes(maps: Mapping[str, LayerMaps], config: TrainConfig, extent: Extent) -> int:
    """Peak memory of a run with a resolved configuration."""
    costs = _decoder_costs(maps, config)
    learned = _COPIES * _FLOAT * sum(cost.parameters for cost in costs)
    texels = _BYTES_PER_GAUSSIAN * sum(len(layer) for layer in maps.values())
    perceived = 2 * _perceived_pixels(config) * _BYTES_PER_PERCEIVED_PIXEL
    pca = max((_PCA_FLOATS * _FLOAT * cost.fit_values * extent.learned for cost in costs), default=0)
    networks = [size for cost in costs for size in cost.activation_bytes] or [0.0]
    step = _BACKWARD * (max(networks) if config.recompute else sum(networks)) + perceived
    # The graph of a step is gone when the PCA is made.
    return int(_LIBRARIES + learned + texels + _picture_bytes(len(maps), config, extent) + max(step, pca))


def disk_bytes(maps: Mapping[str, LayerMaps], config: TrainConfig) -> int:
    """Weights, the checkpoint with moments (while it runs), metrics and previews."""
    return 4 * _FLOAT * sum(cost.parameters for cost in _decoder_costs(maps, config)) + _OTHER_FILES


def scene_requirements(
    maps: Mapping[str, LayerMaps], body: BodyModel, poses: Poses, frames: list[int], config: TrainConfig
) -> dict[str, dict[str, Any]]:
    """{"requires": {layer: its costs}, "left_out": {what: why}}; plain JSON.

    Arguments:
        maps: of the layers that are learned. poses: row = frame. frames: that are learned from.
        config: resolved.
    """
    resting = resting_joints(body, poses, frames)
    requires = {
        name: {
            "texels": len(layer),
            "sheets": layer.views,
            "share_of_the_grid": round(layer.window[2] * layer.window[3] / layer.grid_size**2, 3),
            "joints": joints_used(layer, tuple(resting)),
            "multiply_adds_per_frame": multiply_adds(layer, config.model, len(frames), tuple(resting)),
        }
        for name, layer in maps.items()
    }
    return {"requires": requires, "left_out": left_out(maps, resting, config)}


def resting_joints(body: BodyModel, poses: Poses, frames: list[int]) -> dict[str, str]:
    """Groups of joints that no frame moves, and the joint that carries each (`used_joints.GROUPS`)."""
    rows = frames[:: max(1, len(frames) // _MOST_POSES)]
    return describe_rest(pose_at(body, poses, rows).local_transforms)


def left_out(
    maps: Mapping[str, LayerMaps], resting: Mapping[str, str], config: TrainConfig
) -> dict[str, str]:
    """What a run does without, and why; for `gw train --dry-run` and manifests."""
    model, reasons = config.model, {}
    baked = all(name in LAYERS for name in maps)
    for name in LAYERS if baked else ():
        if name not in maps:
            reasons[f"layer {name}"] = "the labels do not show it: no maps, no network, no loss, no Gaussians"
    for name, layer in maps.items():
        if layer.views <= 2:
            reasons[f"further sheets of {name}"] = "views from front and back leave at most 1 % of it unseen"
        reasons |= decoder_class(model.decoder).omitted(layer, model)
        idle = [group for group in GROUPS if group not in resting and not _follows(layer, group)]
        if idle:
            reasons[f"joints of {name}: {', '.join(idle)}"] = "no texel follows them"
    for group, carrier in resting.items():
        reasons[f"joints: {group}"] = f"at rest in every frame; carried by the {carrier.replace('_', ' ')}"
    if not model.view_conditioning:
        reasons["view dependence"] = "colours of this preset do not depend on the viewing direction"
    if not model.history:
        reasons["recent motion"] = "--history 0"
    if not model.pose_prior:
        reasons["projection of unlike poses"] = "the preset has none"
    if not config.perceptual_digest:
        reasons["LPIPS terms"] = "no --perceptual-weights"
    if not config.track.frame_step or not model.anchors:
        reasons["tracking"] = "no frames are followed (--track-step 0, or nothing that could be)"
    return reasons


def _decoder_costs(maps: Mapping[str, LayerMaps], config: TrainConfig) -> list[DecoderCost]:
    decoder = decoder_class(config.model.decoder)
    return [decoder.cost(layer, config.model) for layer in maps.values()]


def _perceived_pixels(config: TrainConfig) -> int:
    """Pixels of one crop that LPIPS sees; 0 without perceptual weights."""
    return config.perceptual_side**2 if config.perceptual_digest else 0


def _picture_bytes(layers: int, config: TrainConfig, extent: Extent) -> int:
    """Cached crops, views of a step and the next or of a tracked frame, and a render."""
    cached = min(CACHE_BYTES, extent.read * extent.cameras * extent.pixels * CACHE_BYTES_PER_PIXEL)
    pixels = extent.pixels * config.image_scale**2
    if config.patch:
        pixels = min(pixels, config.patch**2)
    view = (_VIEW_FLOATS + layers) * _FLOAT
    tracked_pixels = extent.pixels * (config.track.scale or 1.0) ** 2
    tracked = view * extent.cameras * tracked_pixels if extent.followed else 0
    step = 2 * config.views_per_step * view * pixels
    return int(cached + max(tracked, step) + _RENDER_FLOATS * _FLOAT * pixels)


def _follows(layer: LayerMaps, group: str) -> bool:
    """Whether a texel has weight on a joint of a group."""
    return bool((layer.skin_weights[:, list(GROUPS[group].members)] > 0).any())


def refuse_if_scarce(needed: int, available: int | None, fixes: Callable[[], dict[str, int]]) -> None:
    """End a run that is not likely to fit, before it starts.

    Arguments:
        needed: estimate of the run, bytes. available: free bytes, None where unknown. fixes: options that
            need less, and the bytes that the run would need with each.

    Raises:
        UsageProblem: more than nine tenths of the free memory are needed.
    """
    if available is None or needed <= REFUSED_ABOVE * available:
        return
    raise UsageProblem(
        f"This run needs about {needed / 1e9:.1f} GB of memory, and {available / 1e9:.1f} GB are free.",
        "preset",
        cure(fixes(), available),
    )


def cure(fixes: dict[str, int], available: int | None) -> str:
    """The first of these options that fits, or other advice."""
    for option, needed in fixes.items():
        if available is None or needed <= REFUSED_ABOVE * available:
            return f"Use {option}, which needs about {needed / 1e9:.1f} GB."
    return (
        "Learn from fewer frames (--frame-step, --track-step), close other programs, or use another machine."
    )


@contextmanager
def memory_named(needed: int, fixes: Callable[[], dict[str, int]]) -> Iterator[None]:
    """Turn running out of memory into an error that says which option fits.

    Raises:
        UsageProblem: instead of MemoryError and torch's allocation errors.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_memory_error(error):
            raise
        raise UsageProblem(
            f"Memory ran out; this run was estimated at {needed / 1e9:.1f} GB.",
            "preset",
            cure(fixes(), available_bytes()),
        ) from error


@contextmanager
def guard_memory(
    config: TrainConfig,
    source: Source,
    device: torch.device,
    alternatives: Callable[[], dict[str, TrainConfig]],
) -> Iterator[None]:
    """Refuse a run that is not likely to fit, and name the cure where memory runs out inside the block.

    Arguments:
        config: resolved. alternatives: options, mildest first, and the resolved configuration with each.

    Raises:
        UsageProblem: as `refuse_if_scarce` (on a CPU) and `memory_named`.
    """

    def peak(other: TrainConfig) -> int:
        return memory_bytes(source.layers.maps, other, extent_of(source.sequence, other))

    def fixes() -> dict[str, int]:
        sizes = {option: peak(other) for option, other in alternatives().items()}
        return {option: size for option, size in sizes.items() if size < needed}

    needed = peak(config)

    if device.type == "cpu":
        room = available_bytes()
        refuse_if_scarce(needed, room // on_this_machine() if room else None, fixes)
    with memory_named(needed, fixes):
        yield
