"""Memory that a run will take, before it starts: the peak of the process.

What is counted: libraries; what is learned, with gradient and both moments of Adam, and once more for what a
resumed run reads or the end writes; Gaussians in a step; activations of the networks, and their modulated
weights; pictures, decoded and kept; and at the end the PCA of positional maps.
"""

from __future__ import annotations

from dataclasses import replace

from stages.shared.avatar.maps import LayerMaps
from stages.train.config import PRESETS, TrainConfig
from stages.train.cost import decoder_costs, perceived_pixels
from stages.train.data import KEPT_BYTES, KEPT_BYTES_PER_PIXEL
from stages.train.extent import Extent, extent_of
from stages.train.footage import Footage
from stages.train.resolve import resolve_settings

_FLOAT = 4
_COPIES = 5  # value, gradient, two moments; one more while reading and writing
_LIBRARIES = 540_000_000  # torch, compiled kernels and the rest, measured
_PER_GAUSSIAN = 3000  # maps, and what a step makes of them; measured
_GOING_BACK = 1.2  # gradients on their way, in times what is kept
_PICTURE_FLOATS = 8  # of a pixel in a view: colour, three masks, outline; beside a channel for every layer
_RENDER_FLOATS = 75  # of a pixel while its picture is drawn and compared
_BYTES_PER_PERCEIVED_PIXEL = 2200  # reckoned: activations of VGG-16
_PCA_FLOATS = 7  # of a value of a positional map in one frame


def anchors_of(config: TrainConfig, extent: Extent) -> int:
    """How many anchors every garment gets: one for each frame that is followed, else as configured."""
    if not config.model.anchors:
        return 0
    return extent.followed or min(config.model.anchors, extent.learned)


def memory_bytes(maps: dict[str, LayerMaps], config: TrainConfig, extent: Extent) -> int:
    """Peak of a run with this (resolved) configuration."""
    costs = decoder_costs(maps, config, anchors_of(config, extent)).values()
    learned = _COPIES * _FLOAT * sum(cost.parameters for cost in costs)
    texels = _PER_GAUSSIAN * sum(len(layer) for layer in maps.values())
    perceived = 2 * perceived_pixels(config) * _BYTES_PER_PERCEIVED_PIXEL
    pca = max((_PCA_FLOATS * _FLOAT * cost.fit_values * extent.learned for cost in costs), default=0)
    # The graph of a step is gone when the PCA is made.
    networks = [size for cost in costs for size in cost.activation_bytes] or [0.0]
    step = _GOING_BACK * (max(networks) if config.recompute else sum(networks)) + perceived
    return int(_LIBRARIES + learned + texels + _picture_bytes(len(maps), config, extent) + max(step, pca))


def smaller_runs(maps: dict[str, LayerMaps], config: TrainConfig, footage: Footage) -> dict[str, int]:
    """Options that make a run smaller, the mildest first, and the peak with each.

    `maps` are those of the method as it is; other presets are reckoned on the same maps.
    """
    presets = [(f"--preset {name}", PRESETS[name]) for name in ("balanced", "draft", "tiny")]
    others = [("--recompute", replace(config, recompute=True))]
    kept = {"method": config.method, "minutes": config.minutes}
    others += [(option, replace(preset, **kept)) for option, preset in presets]  # type: ignore[arg-type]
    whole = memory_bytes(maps, config, extent_of(footage, config))
    sizes = {
        o: memory_bytes(maps, c, extent_of(footage, c))
        for o, c in ((o, resolve_settings(c)) for o, c in others)
    }
    return {option: size for option, size in sizes.items() if size < whole}


def _picture_bytes(layers: int, config: TrainConfig, extent: Extent) -> int:
    """Decoded crops that are kept, views of a step and the next or of a tracked frame, and a render."""
    kept = min(KEPT_BYTES, extent.read * extent.cameras * extent.pixels * KEPT_BYTES_PER_PIXEL)
    shown = extent.pixels * config.image_scale**2
    if config.patch:
        shown = min(shown, config.patch**2)
    view = (_PICTURE_FLOATS + layers) * _FLOAT
    followed = view * extent.cameras * extent.pixels if extent.followed else 0
    return int(
        kept + max(followed, 2 * config.views_per_step * view * shown) + _RENDER_FLOATS * _FLOAT * shown
    )
