"""Evaluation with perceptual weights fills the column that is empty without them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from safetensors.torch import save_file

from stages.evaluate import stage
from stages.evaluate.config import EvaluateConfig, EvaluateInputs
from stages.shared.losses import perceptual
from tests.shared.losses.perceptual_weights import random_weights

NARROW = tuple(
    tuple((index, 3 if index == 0 else 4, 4) for index, _, _ in block) for block in perceptual.BLOCKS
)


def test_lpips_is_scored_with_the_file(
    dressed_subject: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(perceptual, "BLOCKS", NARROW)
    monkeypatch.setattr("stages.shared.metrics.scores._LPIPS_SIDE", 64)
    save_file(random_weights(NARROW), tmp_path / "weights.safetensors")
    config = EvaluateConfig(splits=("novel-view",), frame_step=2, pictures=1)
    result = stage.run(
        EvaluateInputs(dressed_subject),
        tmp_path / "out",
        config,
        perceptual_weights=tmp_path / "weights.safetensors",
    )
    written = json.loads((tmp_path / "out/evaluation.json").read_bytes())
    content = (tmp_path / "weights.safetensors").read_bytes()
    assert written["perceptual_digest"] == hashlib.sha256(content).hexdigest()
    scores = result.summary["novel_view"]
    assert 0 < scores["trained"]["lpips"] < scores["baseline"]["lpips"]
