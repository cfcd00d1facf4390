"""Configuration of `gw distill`."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option


@dataclass(frozen=True)
class DistillConfig:
    """How the networks of a trained subject become blendshapes.

    Attributes:
        seed: of the blended poses.
        training_poses: largest number of poses of the training motion, evenly spread over it.
        blended_poses: poses half-way between random pairs of them, joint by joint.
        extra_poses: largest number of poses of each further motion.
        offset_tolerance, color_tolerance, form_tolerance: m, and the units before the activations; bases are
            added until what they leave out is smaller than this (root mean square over texels and poses).
    """

    seed: int = 0
    training_poses: int = 200
    blended_poses: int = 56
    extra_poses: int = 100
    offset_tolerance: float = 0.0005
    color_tolerance: float = 0.02
    form_tolerance: float = 0.02
    most: tuple[int, int, int] = option(
        (32, 12, 8), "Largest numbers of bases for offsets, colours and form, as 16,6,4.", flag="--ranks"
    )


PRESETS: dict[str, DistillConfig] = {
    "tiny": DistillConfig(training_poses=12, blended_poses=4, most=(6, 3, 2)),
    "draft": DistillConfig(),
    "balanced": DistillConfig(blended_poses=200, most=(64, 24, 12)),
    "paper": DistillConfig(training_poses=400, blended_poses=400, most=(128, 48, 24)),
}
