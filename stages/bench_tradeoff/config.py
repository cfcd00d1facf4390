"""Settings of `gw bench tradeoff`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Decoder:
    """How a trained subject is played: as it was trained, or by blendshapes with at most so many bases.

    Attributes:
        name: in tables. ranks: for offsets, colours and form; None: as trained.
        trained: blendshapes are trained by themselves instead of distilled.
    """

    name: str
    ranks: tuple[int, int, int] | None
    trained: bool = False


AS_TRAINED = Decoder("as trained", None)
DECODERS = (AS_TRAINED, Decoder("blendshapes", (32, 12, 8)), Decoder("few blendshapes", (4, 1, 1)))
TRAINED_BLENDSHAPES = Decoder("trained blendshapes", (24, 8, 4), trained=True)


@dataclass(frozen=True)
class BenchTradeoffConfig:
    """Which operating points are measured.

    Attributes:
        minutes: of training, over all pitches (and decoders that are trained by themselves) together.
        preset: of every stage.
        pitches: millimetres per texel; each is trained once.
        decoders: each is played and scored for every pitch.
        size: pixels, width and height of the pictures that are timed. frames: how many are timed.
        frame_step, test_frame_step: of the views that are scored, as in `gw evaluate`.
        seed: of the trainings.
    """

    minutes: float = 24.0
    preset: str = "draft"
    pitches: tuple[float, ...] = (6.5, 9.0, 13.0, 20.0)
    decoders: tuple[Decoder, ...] = DECODERS
    size: int = 512
    frames: int = 40
    frame_step: int = 10
    test_frame_step: int = 2
    seed: int = 0
