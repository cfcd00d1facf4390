"""Which commands the bench runs, in which order, and what becomes of their answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stages.workflows.command import Outcome
from stages.workflows.tradeoff import stage
from stages.workflows.tradeoff.config import DECODERS, TRAINED_BLENDSHAPES, BenchTradeoffConfig, Training
from stages.workflows.tradeoff.stage import read_points

SCORES = {"psnr_foreground": 15.0, "ssim_foreground": 0.8, "miou": 0.9, "sharpness": 0.5}


@pytest.mark.parametrize("trained", [False, True])
def test_every_decoder_of_every_pitch_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trained: bool
) -> None:
    ran: list[list[str]] = []

    def pretended(*arguments: str | Path, folder: Path | None = None) -> Outcome:
        words = [str(argument) for argument in arguments]
        ran.append(words)
        result: dict[str, Any] = {}
        if words[0] == "bake-maps":
            fine = float(words[words.index("--pitch") + 1]) if "--pitch" in words else 4.0
            result = {"pitch": fine / 1000}
        if words[0] == "train":
            result = {"layers": ["body", "upper"]}
        if words[0] == "export-garment":
            Path(words[words.index("-o") + 1]).write_bytes(b"1234")
        if words[0] == "bench":
            result = {"gaussians": 7, "frames_per_second": 30.0}
        if words[0] == "evaluate":
            method = words[words.index("--methods") + 1]
            result = {split: {method: SCORES} for split in ("novel_view", "novel_pose")}
        return Outcome(1.0, 100, result)

    decoders = (TRAINED_BLENDSHAPES, *DECODERS) if trained else DECODERS
    config = BenchTradeoffConfig(minutes=8.0, pitches=(10.0, 20.0), decoders=decoders)
    config = replace(config, also=(Training("balanced", 5.0),))
    stage.run(tmp_path / "capture", tmp_path / "out", config, pretended)
    points = read_points(tmp_path / "out")
    assert len(points) == 2 * len(decoders) + 1 and all(point.bundle_bytes == 8 for point in points)
    trainings = [words for words in ran if words[0] == "train"]
    whole = trainings.pop()
    assert whole[:3] == ["train", *whole[1:2], "--preset"] and "balanced" in whole and "5" in whole
    assert points[-1].name == "balanced-4-mm-as-trained" and points[-1].training_minutes == 5.0
    assert len(trainings) == (4 if trained else 2)
    minutes = {words[words.index("--minutes") + 1] for words in trainings}
    assert minutes == {"2" if trained else "4"}
    order = [words[0] for words in ran]
    assert order.count("distill") == 2
    if trained:
        assert trainings[1][-4:] == ["--decoder", "blendshapes", "--ranks", "24,8,4"]
        ran = ran[: len(ran) - 1 - order[::-1].index("bake-maps")]  # what came before the whole preset
        order = [words[0] for words in ran]
        last = len(order) - 1 - order[::-1].index("train")
        assert "distill" not in order[last:], "the trained ones are not distilled"
        assert all("--distilled" not in words for words in ran[last:])
        assert any(point.name == "20-mm-trained-blendshapes" for point in points)
