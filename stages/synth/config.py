"""Configuration of the synthetic captures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SynthConfig:
    """How large the synthetic captures are; every size is independent of the others.

    Attributes:
        image_size: width and height of every image, pixels.
        supersample: rays per pixel along each side.
        cameras: training cameras on the ring; one more between two of them is held out.
        train_images: frames of the training take that have images.
        train_stride: simulated frames (1/30 s) from one training image to the next.
        test_images: frames of the held-out take that have images.
        test_stride: simulated frames from one held-out image to the next.
        cloth_spacing: distance of neighbouring cloth vertices, metres.
        substeps: cloth simulation steps per frame of 1/30 s.
        ambient_rays: rays per vertex for soft shadows; 0 leaves them out.
        jpeg: images as JPEG (quality 95) instead of PNG.
        seed: of everything random.
    """

    image_size: int = 448
    supersample: int = 2
    cameras: int = 8
    train_images: int = 32
    train_stride: int = 5
    test_images: int = 10
    test_stride: int = 8
    cloth_spacing: float = 0.017
    substeps: int = 60
    ambient_rays: int = 24
    jpeg: bool = True
    seed: int = 0


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
