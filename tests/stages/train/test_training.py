"""Training a tiny subject: it learns, resumes to the bit, survives NaN and Ctrl-C."""

from __future__ import annotations

import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from stages.pipeline import BAKE_MAPS, TRAIN
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.spec import StageResult
from stages.shared.avatar.compose import compose
from stages.shared.avatar.config import PAPER_MODEL
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import embedded_body
from stages.shared.capture import open_capture
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.train import loop, stage, trainer
from stages.train.config import LearningRates, LossWeights
from stages.train.objective import picture_terms, weighted
from tests.listening import Listener
from tests.stages.train.scene import SIZE, look, make_subject, poses, tiny


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("tiny")).parent


@pytest.fixture
def subject(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared, tmp_path / "copy")
    return tmp_path / "copy" / "subject"


def _weights(result: StageResult) -> dict[str, np.ndarray]:
    return {
        f"{layer}.{name}": values
        for layer in ("body", "upper")
        for name, values in result.artifact.arrays(layer).items()
    }


def test_learning_lowers_the_loss_and_writes_a_whole_artifact(subject: Path) -> None:
    result = stage.run(subject, tiny(steps=60))
    lines = [json.loads(line) for line in result.artifact.record("metrics.jsonl").splitlines()]
    assert lines[-1]["losses"]["l1"] < 0.5 * lines[0]["losses"]["l1"]
    assert {"data", "network", "splat", "surface", "optimiser"} <= lines[-1]["seconds"].keys()
    assert lines[-1]["gradient_norm"] > 0
    assert {
        "l1",
        "ssim",
        "label",
        "silhouette",
        "penetration",
        "offset",
        "smooth",
        "seam",
        "opacity",
    } <= lines[-1]["losses"].keys()
    previews = [name for name in result.artifact.records if name.startswith("previews/")]
    assert previews and result.artifact.record(previews[0])[:4] == b"\x89PNG"
    settings = result.artifact.json("model.json")["layers"]
    baked = Workspace(subject).require(BAKE_MAPS)
    fresh, learned = {}, {}
    for name in ("body", "upper"):
        tensors = {key: torch.from_numpy(value) for key, value in result.artifact.arrays(name).items()}
        learned[name] = StyleUNetDecoder.from_state(settings[name], LayerMaps.load(baked, name), tensors)
        fresh[name] = StyleUNetDecoder(LayerMaps.load(baked, name), tiny().model)
    assert _held_out_psnr(subject, learned) > _held_out_psnr(subject, fresh) + 5
    assert stage.run(subject, tiny(steps=60)).artifact.path == result.artifact.path, (
        "up to date: not done again"
    )


def _held_out_psnr(subject: Path, models: dict[str, StyleUNetDecoder]) -> float:
    """PSNR inside the mask, of the camera that training never sees."""
    take = open_capture(subject.parent / "capture").training_takes[0]
    seen = look(models, embedded_body(), poses(), 2, take.camera("cam2"))
    inside = take.mask("cam2", 2) > 127
    error = (seen.color.numpy() - take.image("cam2", 2) / 255.0)[inside]
    return float(-10 * np.log10(np.square(error).mean()))


def test_interrupted_run_resumes_to_the_bit(
    prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, split = tmp_path / "whole", tmp_path / "split"
    shutil.copytree(prepared, whole)
    shutil.copytree(prepared, split)
    through = stage.run(whole / "subject", tiny(steps=12))
    straight = _weights(through)
    step = trainer.Trainer.step

    def interrupted(self: trainer.Trainer, number: int, elapsed: float) -> trainer.StepReport:
        if number == 5:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, number, elapsed)

    monkeypatch.setattr(trainer.Trainer, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stage.run(split / "subject", tiny(steps=12))
    monkeypatch.undo()
    assert Workspace(split / "subject").current(TRAIN) is None
    resumed = stage.run(split / "subject", tiny(steps=12))
    for name, values in _weights(resumed).items():
        assert np.array_equal(values, straight[name]), name
    assert resumed.artifact.digest == through.artifact.digest
    lines = [json.loads(line) for line in resumed.artifact.record("metrics.jsonl").splitlines()]
    assert [line["step"] for line in lines] == sorted({line["step"] for line in lines})


def test_nan_is_found_in_its_step_and_skipped(subject: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _spoil(monkeypatch, {3, 7})
    heard = Listener()
    result = stage.run(subject, tiny(steps=12), heard)
    assert result.summary["skipped"] == 2
    assert [text.split()[1] for text in heard.warnings] == ["3", "7"]
    assert all(np.isfinite(values).all() for values in _weights(result).values())


def test_three_nan_in_a_row_stop_with_a_folder_to_repeat_from(
    subject: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _spoil(monkeypatch, {4, 5, 6})
    with pytest.raises(BadData) as caught:
        stage.run(subject, tiny(steps=12))
    assert caught.value.exit_code == 65
    facts = json.loads((Path(caught.value.where) / "step.json").read_text())
    assert facts["step"] == 6 and facts["cameras"]
    assert (Path(caught.value.where) / "weights.safetensors").is_file()
    assert Workspace(subject).current(TRAIN) is None


def test_missing_stages_and_devices_are_said(tmp_path: Path, subject: Path) -> None:
    with pytest.raises(MissingInput):
        stage.run(tmp_path / "nowhere", tiny())
    with pytest.raises(UsageProblem):
        stage.run(subject, tiny(device="abacus"))


def test_published_kind_of_model_trains_too(subject: Path) -> None:
    model = replace(PAPER_MODEL, width=0.0625, depth=2, style=8)
    result = stage.run(subject, tiny(steps=20, model=model, rates=LearningRates(network=0.01)))
    lines = [json.loads(line) for line in result.artifact.record("metrics.jsonl").splitlines()]
    assert lines[-1]["losses"]["l1"] < lines[0]["losses"]["l1"]
    assert result.summary["skipped"] == 0
    first = _weights(result)
    assert any(name.startswith("body.view_net") and np.abs(v).sum() > 0 for name, v in first.items())


def test_minutes_end_a_run_before_its_steps(subject: Path) -> None:
    result = stage.run(subject, tiny(steps=10_000, minutes=0.02))
    assert 0 < result.summary["steps"] < 10_000


def test_dry_run_writes_nothing_and_estimates(subject: Path) -> None:
    before = sorted(path.name for path in subject.rglob("*"))
    planned = stage.plan(subject, tiny())
    assert planned.seconds and planned.memory_bytes and planned.disk_bytes
    assert sorted(path.name for path in subject.rglob("*")) == before


def _spoil(monkeypatch: pytest.MonkeyPatch, steps: set[int]) -> None:
    """Make the picture losses of some steps NaN, each time the step is tried."""
    genuine, current = trainer.picture_terms, {"step": -1}
    step = trainer.Trainer.step

    def numbered(self: trainer.Trainer, number: int, elapsed: float) -> trainer.StepReport:
        current["step"] = number
        return step(self, number, elapsed)

    def spoilt(*arguments: object) -> dict[str, torch.Tensor]:
        terms = genuine(*arguments)  # type: ignore[arg-type]
        if current["step"] in steps:
            terms["l1"] = terms["l1"] * float("nan")
        return terms

    monkeypatch.setattr(trainer.Trainer, "step", numbered)
    monkeypatch.setattr(trainer, "picture_terms", spoilt)
    assert loop.Trainer is trainer.Trainer


@pytest.mark.parametrize("tracked", [0, 1])
def test_views_that_show_nobody_are_left_out_and_named(subject: Path, tracked: int) -> None:
    take = open_capture(subject.parent / "capture").training_takes[0]
    for frame in (1, 3):
        cv2.imwrite(str(take.view("cam1", frame).mask), np.zeros((SIZE, SIZE), np.uint8))
    listener = Listener()
    config = tiny(steps=8, track=replace(tiny().track, frame_step=tracked, warm_up=2))
    assert stage.plan(subject, config).memory_bytes > 0
    result = stage.run(subject, config, listener)
    assert result.summary["steps"] == 8 and result.summary["skipped"] == 0
    assert any("cam1: 1, 3" in text for text in listener.warnings)


def test_a_view_that_shows_nobody_teaches_nothing(subject: Path) -> None:
    take = open_capture(subject.parent / "capture").training_takes[0]
    cv2.imwrite(str(take.view("cam1", 2).mask), np.zeros((SIZE, SIZE), np.uint8))
    prepared = stage.prepare(subject, tiny())
    view = prepared.views.view(2, "cam1")
    composite = compose(prepared.posed(2))
    weights = LossWeights(flow=1.0, silhouette=1.0)
    terms = picture_terms(composite, view, torch.full((3,), 0.3), weights, "l1")
    assert {"l1", "ssim", "label", "silhouette"} <= set(terms)
    assert all(abs(float(term.detach())) < 1e-6 for term in terms.values()), terms
    weighted(terms, weights).backward()
    for parameter in prepared.parameters.values():
        assert parameter.grad is None or not parameter.grad.any()
