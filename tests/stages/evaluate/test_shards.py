"""Evaluation in parts: merged files are those of one run, but for the time it took."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.evaluate import stage
from stages.evaluate.config import EvaluateConfig, EvaluateInputs
from stages.render import stage as render
from stages.shared.errors import BadData, UsageProblem
from stages.shared.render_sequence.config import RenderConfig
from tests.listening import Listener

CONFIG = EvaluateConfig(frame_step=2, test_frame_step=2, cameras=1, pictures=2, supersampling=1)


def contents(folder: Path) -> dict[str, object]:
    """All files; of evaluation.json everything but the seconds."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    found: dict[str, object] = {name: path.read_bytes() for name, path in files.items()}
    found["evaluation.json"] = {**json.loads(files["evaluation.json"].read_bytes()), "seconds": 0}
    return found


def test_parts_of_a_subject_merge_to_the_same_bytes(dressed_subject: Path, tmp_path: Path) -> None:
    whole = stage.run(EvaluateInputs(dressed_subject), tmp_path / "whole", CONFIG)
    out = tmp_path / "out"
    for index, frames in ((2, 2), (3, 2), (1, 2)):
        part = stage.run(EvaluateInputs(dressed_subject), out, replace(CONFIG, shard=f"{index}/3"))
        assert not part.complete and not out.exists()
        assert part.summary == {"shard": f"{index}/3", "frames": frames, "kept": 0}
    report = Listener()
    merged = stage.run(EvaluateInputs(dressed_subject), out, CONFIG, report)
    assert merged.complete and not report.progressed and "6 of 6" in report.said[-1]
    assert contents(out) == contents(whole.path) and {"novel_view_1.png", "views.json"} <= set(contents(out))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]


def test_an_interrupted_evaluation_goes_on(dressed_subject: Path, tmp_path: Path) -> None:
    config = replace(CONFIG, methods=("trained",), splits=("novel-pose",), pictures=1)
    whole = stage.run(EvaluateInputs(dressed_subject), tmp_path / "whole", config)
    with pytest.raises(KeyboardInterrupt):
        stage.run(EvaluateInputs(dressed_subject), tmp_path / "out", config, Listener(stop=1))
    (part,) = tmp_path.glob(".out.part-*")
    (part / "novel_pose_0.png").write_bytes(b"half a picture")  # a kill came before its record was written
    (part / "records/000000.json").rename(part / "records/.000000.json.tmp-1")
    report = Listener()
    stage.run(EvaluateInputs(dressed_subject), tmp_path / "out", config, report)
    assert len(report.progressed) == 3 and "views.json" in contents(tmp_path / "out")
    assert contents(tmp_path / "out") == contents(whole.path)


def test_another_truth_is_not_mixed_in(dressed_subject: Path, tmp_path: Path) -> None:
    """Parts of a picture that has changed since do not count."""
    pictures, true = tmp_path / "pictures", tmp_path / "truth"
    random = np.random.default_rng(0)
    for folder in (pictures, true):
        folder.mkdir()
        for name in range(3):
            cv2.imwrite(str(folder / f"{name}.png"), random.integers(0, 255, (32, 32, 3)).astype(np.uint8))
    out, config = tmp_path / "out", EvaluateConfig(pictures=1)
    stage.run(EvaluateInputs(images=pictures, truth=true), out, config=replace(config, shard="1/2"))
    shutil.copy(pictures / "0.png", true / "0.png")
    stage.run(EvaluateInputs(images=pictures, truth=true), out, config=replace(config, shard="2/2"))
    report = Listener()
    merged = stage.run(EvaluateInputs(images=pictures, truth=true), out, config, report)
    assert len(report.progressed) == 2 and merged.complete  # of three pictures one was scored since
    assert contents(out) == contents(
        stage.run(EvaluateInputs(images=pictures, truth=true), tmp_path / "whole", config).path
    )
    first, *others = json.loads((out / "views.json").read_bytes())["images"]
    assert first["psnr"] is None and None not in [row["psnr"] for row in others]  # equal: infinite


def test_parts_of_rendered_frames_merge(dressed_subject: Path, tmp_path: Path) -> None:
    capture, frames = dressed_subject.parent / "capture", tmp_path / "frames"
    config = RenderConfig(take="other", frames="0:2", penetration=False)
    render.run([dressed_subject], None, capture, frames, config)
    whole = stage.run(EvaluateInputs(frames=frames, truth=capture), tmp_path / "whole", CONFIG)
    for index in (1, 2):
        stage.run(
            EvaluateInputs(frames=frames, truth=capture),
            tmp_path / "out",
            replace(CONFIG, shard=f"{index}/2"),
        )
    report = Listener()
    stage.run(EvaluateInputs(frames=frames, truth=capture), tmp_path / "out", CONFIG, report)
    assert contents(tmp_path / "out") == contents(whole.path) and not report.progressed
    damaged = frames / "frames/cam0/000001.png"
    damaged.write_bytes(damaged.read_bytes()[:50])
    with pytest.raises(BadData):
        stage.run(EvaluateInputs(frames=frames, truth=capture), tmp_path / "out", CONFIG)


def test_command(dressed_subject: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["evaluate", str(dressed_subject), "-o", str(tmp_path / "out"), "--split", "novel-view"]
    words += ["--frame-step", "4", "--methods", "trained"]
    monkeypatch.setattr("sys.argv", ["gw", *words, "--shard=1/2"])
    done = CliRunner().invoke(app, [*words, "--shard", "1/2"])
    assert done.exit_code == 0 and f"next: gw {' '.join(words)}   # when all" in done.stderr, done.stderr
    for more in ([], ["--dry-run"]):
        assert CliRunner().invoke(app, [*words, "--shard", "3/2", *more]).exit_code == 2
    with pytest.raises(UsageProblem, match="part of the work"):
        stage.run(
            EvaluateInputs(images=tmp_path, truth=tmp_path),
            tmp_path / "out",
            config=EvaluateConfig(shard="0/2"),
        )
