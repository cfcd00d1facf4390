"""Splat cut-offs are options of a film: coarser ones change it a little, impossible ones are refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from typer.testing import CliRunner

from gw_cli.app import app


def test_coarser_is_nearly_the_same_film(wardrobe: Path, tmp_path: Path) -> None:
    given = ["tryon", str(wardrobe / "body.gwg"), str(wardrobe / "upper.gwg"), "--preset", "tiny", "--json"]
    given += ["--poses", str(wardrobe / "motion.npz"), "--frames", "0:1"]
    coarse = ["--alpha-min", "0.05", "--transmittance-min", "0.05"]
    frames = []
    for name, options in (("fine", []), ("coarse", coarse)):
        done = CliRunner().invoke(app, [*given, "-o", str(tmp_path / name), *options])
        assert done.exit_code == 0, done.output
        picture = cv2.imread(str(tmp_path / name / "frames" / "000000.png"), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        frames.append(picture[..., :3] * (picture[..., 3:] / 255.0))
    difference = np.abs(frames[0] - frames[1])
    assert difference.max() > 1 and np.square(difference / 255).mean() < 1e-3
    config = json.loads((tmp_path / "coarse" / "result.json").read_text())["config"]
    assert config["alpha_min"] == 0.05 and config["transmittance_min"] == 0.05
    for option in ("--alpha-min", "--transmittance-min"):
        refused = CliRunner().invoke(app, [*given, "-o", str(tmp_path / "none"), option, "0.7"])
        assert refused.exit_code == 2
