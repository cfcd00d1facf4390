"""`gw bench playback` on a tiny outfit: what it reports belongs together."""

from __future__ import annotations

from pathlib import Path

import pytest

from stages.shared.artifacts.bundle import write_bundle
from stages.shared.errors import UsageProblem
from stages.workflows import playback as stage
from stages.workflows.config import PlaybackConfig
from tests.shared.outfit.wardrobe import bundle, motion, worn


@pytest.fixture(scope="module")
def outfit(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    folder = tmp_path_factory.mktemp("outfit")
    for name in ("body", "upper"):
        write_bundle(folder / f"{name}.gwg", bundle(worn(name, source=name)))
    motion(8).save(folder / "motion.npz")
    return [folder / "body.gwg", folder / "upper.gwg"], folder / "motion.npz"


def test_times_add_up(outfit: tuple[list[Path], Path]) -> None:
    config = PlaybackConfig(frames=4, size=48, plain_frames=1, threads=2)
    found = stage.run(*outfit, config).summary
    split = found["milliseconds"]
    one = 1000 / (split["pose"] + split["picture"])
    assert found["one_after_the_other_frames_per_second"] == pytest.approx(one, rel=0.02)
    assert found["frames"] == 4 and found["threads"] == 2 and found["layers"] == ["body", "upper"]
    assert found["decoders"] == {"body": "styleunet", "upper": "styleunet"}
    assert 0 <= found["penetration_share"] < 1 and found["frames_per_second"] > 0


def test_nothing_to_play_is_refused(outfit: tuple[list[Path], Path]) -> None:
    with pytest.raises(UsageProblem):
        stage.run(*outfit, PlaybackConfig(frames=0))
