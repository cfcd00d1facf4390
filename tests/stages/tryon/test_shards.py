"""Try-on in parts: merged bytes are those of one run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.errors import UsageProblem
from stages.shared.render_sequence.config import RenderConfig
from stages.tryon import stage
from tests.listening import Listener

SMALL = RenderConfig(width=48, height=64, passes=("labels",))


def contents(folder: Path) -> dict[str, bytes]:
    """All files but result.json, which holds times."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    assert "result.json" in files
    return {name: path.read_bytes() for name, path in files.items() if name != "result.json"}


def test_parts_merge_to_the_same_bytes(wardrobe: Path, tmp_path: Path) -> None:
    bundles = [wardrobe / f"{name}.gwg" for name in ("body", "lower", "upper")]
    motion, whole, out = wardrobe / "motion.npz", tmp_path / "whole", tmp_path / "out"
    stage.run(bundles, motion, whole, SMALL)
    for index in (2, 1):
        part = stage.run(bundles, motion, out, replace(SMALL, shard=f"{index}/2"))
        assert not part.complete and not out.exists()
        assert part.summary == {"shard": f"{index}/2", "frames": 4 - index, "kept": 0}
    report = Listener()
    merged = stage.run(bundles, motion, out, SMALL, report)
    assert merged.complete and merged.summary["kept_frames"] == 5 and not report.progressed
    assert contents(out) == contents(whole) and {"tryon.mp4", "frames/000004.png"} <= set(contents(out))
    one, other = (json.loads((folder / "result.json").read_text()) for folder in (whole, out))
    assert {name for name in one if one[name] != other[name]} <= {
        "seconds",
        "frames_per_second",
        "kept_frames",
    }


@pytest.mark.parametrize("shard", ["3/2", "0/2", "1/0", "-1/2", "2", "1/", "1/2/3", "a/b", "1.5/2"])
def test_strange_parts_are_refused_before_anything_is_read(shard: str, tmp_path: Path) -> None:
    with pytest.raises(UsageProblem, match="part of the work") as caught:
        stage.run([tmp_path / "none.gwg"], tmp_path / "none.npz", tmp_path / "out", RenderConfig(shard=shard))
    assert caught.value.where == "option --shard" and "1/4" in caught.value.fix


def test_the_command_says_what_to_type_when_all_parts_are_done(
    wardrobe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["tryon", str(wardrobe / "body.gwg"), "--poses", str(wardrobe / "motion.npz")]
    words += ["-o", str(tmp_path / "out"), "--width", "32", "--height", "32"]
    monkeypatch.setattr("sys.argv", ["gw", *words, "--shard", "1/2"])
    done = CliRunner().invoke(app, [*words, "--shard", "1/2"])
    assert done.exit_code == 0, done.stderr
    assert f"next: gw {' '.join(words)}   # when all parts are done" in done.stderr
    assert CliRunner().invoke(app, [*words, "--shard", "2/1"]).exit_code == 2
    alone = ["render", str(wardrobe / "body.gwg"), "--html", str(tmp_path / "a.html"), "--shard", "1/2"]
    refused = CliRunner().invoke(app, alone)
    assert refused.exit_code == 2 and "in parts" in refused.stderr
