"""Memory does not grow with the length of a sequence."""

from __future__ import annotations

from pathlib import Path

import pytest

from gw_cli.child import run_command
from stages.shared.artifacts.bundle import write_bundle
from tests.shared.outfit.wardrobe import bundle, motion, worn


@pytest.mark.long
def test_a_thousand_frames_take_the_memory_of_fifty(tmp_path: Path) -> None:
    for name in ("body", "upper"):
        write_bundle(tmp_path / f"{name}.gwg", bundle(worn(name, source=name)))
    bundles, peaks = [tmp_path / "body.gwg", tmp_path / "upper.gwg"], {}
    for frames in (50, 1000):
        poses = tmp_path / f"{frames}.npz"
        motion(frames).save(poses)
        out = tmp_path / f"out{frames}"
        outcome = run_command(
            "render", *bundles, "--poses", poses, "-o", out, "--width", "96", "--height", "96"
        )
        assert outcome.result["pictures"] == frames
        peaks[frames] = outcome.peak_bytes
    assert peaks[1000] < 1.05 * peaks[50] and peaks[1000] < 1.5 * 2**30
