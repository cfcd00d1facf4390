"""Settings of `gw bench tradeoff`. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option


@dataclass(frozen=True)
class Decoder:
    """How a trained subject is played: as trained, or by blendshapes with a maximum number of bases.

    Attributes:
        name: as in tables. ranks: numbers of bases for offsets, colours and form; None means as trained.
        trained: blendshapes are trained directly instead of distilled.
    """

    name: str
    ranks: tuple[int, int, int] | None
    trained: bool = False


AS_TRAINED = Decoder("as trained", None)
DECODERS = (AS_TRAINED, Decoder("blendshapes", (32, 12, 8)))
TRAINED_BLENDSHAPES = Decoder("trained blendshapes", (24, 8, 4), trained=True)


@dataclass(frozen=True)
class Training:
    """One training of the subject.

    Attributes:
        preset: of bake-maps and train. minutes: of training. pitch: mm per texel, None for the preset's own.
    """

    preset: str
    minutes: float
    pitch: float | None = None


@dataclass(frozen=True)
class BenchTradeoffConfig:
    """The operating points to measure.

    Attributes:
        preset: of every stage.
        pitches: millimetres per texel; each is trained once.
        decoders: each is played and scored for every pitch.
        also: trainings of whole presets, played as they were trained.
        frames: how many are timed.
        frame_step, test_frame_step: of the views that are scored, as in `gw evaluate`.
        seed: of the trainings.
    """

    minutes: float = option(24.0, "Of training, over all pitches and trained decoders together.", min=0.1)
    preset: str = "draft"
    pitches: tuple[float, ...] = (6.5, 9.0, 13.0, 20.0)
    decoders: tuple[Decoder, ...] = DECODERS
    also: tuple[Training, ...] = ()
    size: int = option(512, "Pixels, width and height of the pictures that are timed.", min=16, max=4096)
    frames: int = 40
    frame_step: int = 10
    test_frame_step: int = 2
    seed: int = 0

    @property
    def trainings(self) -> tuple[Training, ...]:
        """One training per pitch and per trained decoder, with equal shares of the minutes."""
        count = len(self.pitches) * (1 + sum(decoder.trained for decoder in self.decoders))
        return tuple(Training(self.preset, self.minutes / count, pitch) for pitch in self.pitches)
