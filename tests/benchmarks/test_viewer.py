"""The benchmark of the viewer's page prints what it measured."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from tests.benchmarks.viewer import app


def test_the_rates_of_page_server_and_drawing(wardrobe: Path) -> None:
    words = [str(wardrobe / "body.gwg"), str(wardrobe / "upper.gwg"), "--poses", str(wardrobe / "motion.npz")]
    done = CliRunner().invoke(app, [*words, "--seconds", "2", "--width", "320", "--height", "240", "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout.splitlines()[-1])["result"]
    assert found["gaussians"] > 0 and found["renderer"] and found["window"] == [320, 240]
    assert min(found["page_fps"], found["server_alone_fps"], found["drawing_alone_fps"]) > 0
