"""Configuration of the synthetic captures."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option


@dataclass(frozen=True)
class SynthConfig:
    """How large the synthetic captures are; every size is independent of the others.

    The motions are at 30 frames/s. The help of each field is in its metadata.
    """

    image_size: int = option(448, "Width and height of every image, pixels.", min=16, max=4096)
    supersample: int = option(2, "Rays per pixel along each side.", min=1, max=8)
    cameras: int = option(8, "Training cameras on the ring; one more between two of them is held out.", min=1)
    train_images: int = option(32, "Frames of the training take that have images.", min=1)
    train_stride: int = option(5, "Simulated frames from one training image to the next.", min=1)
    test_images: int = option(10, "Frames of the held-out take that have images.", min=1)
    test_stride: int = option(8, "Simulated frames from one held-out image to the next.", min=1)
    cloth_spacing: float = option(
        0.017, "Distance of neighbouring cloth vertices, metres.", min=0.008, max=0.06
    )
    substeps: int = option(60, "Cloth simulation steps per frame.", min=1)
    ambient_rays: int = option(24, "Rays per vertex for soft shadows; 0 leaves them out.", min=0)
    jpeg: bool = option(True, "Images as JPEG (quality 95), or as PNG.")
    seed: int = option(0, "Seed of all random numbers.", min=0)


PRESETS: dict[str, SynthConfig] = {
    "tiny": SynthConfig(
        image_size=112,
        cameras=4,
        train_images=4,
        train_stride=15,
        test_images=2,
        test_stride=15,
        cloth_spacing=0.036,
        substeps=30,
        ambient_rays=0,
    ),
    "draft": SynthConfig(),
    "balanced": SynthConfig(
        image_size=640,
        supersample=3,
        train_images=54,
        train_stride=3,
        test_images=20,
        test_stride=4,
        cloth_spacing=0.013,
    ),
    "paper": SynthConfig(
        image_size=1024,
        supersample=3,
        cameras=24,
        train_images=160,
        train_stride=1,
        test_images=80,
        test_stride=1,
        cloth_spacing=0.012,
    ),
}
