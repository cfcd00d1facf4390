"""An outer garment over a known body: what stays to the bit, what goes on, what is refused and noticed."""

from __future__ import annotations

import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from gw_cli.app import app
from stages.distill import stage as distill
from stages.distill.config import DistillConfig
from stages.export_garment import stage as export_garment
from stages.export_garment.config import ExportGarmentConfig
from stages.pipeline import BAKE_MAPS, PIPELINE, TRAIN
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.bundle import read_bundle
from stages.shared.artifacts.staleness import staleness
from stages.shared.avatar.compose import compose
from stages.shared.body import embedded_body
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.train import stage
from stages.train.config import LossWeights, TrackConfig
from stages.train.objective import render
from stages.train.reporting import StepReport
from stages.train.trainer import Trainer
from stages.train.warm_start import PretrainedLayers
from tests.listening import Listener
from tests.shared.avatar.tubes import tube_arrays
from tests.stages.train.scene import cameras, make_subject, poses, tiny

_PITCH, _GRID = 0.025, 80  # the outer outfit's own grid; the inner's is finer


def _outer_layers() -> dict[str, dict[str, np.ndarray]]:
    shapes: dict[str, dict[str, object]] = {
        "body": {"radius": 0.12},
        "upper": {"radius": 0.15, "low": -0.1, "high": 0.2, "color": (0.2, 0.5, 0.9)},
        "outer": {"radius": 0.18, "low": 0.0, "high": 0.25, "color": (0.9, 0.8, 0.1)},
    }
    return {
        name: tube_arrays(**shape, pitch=_PITCH, grid=_GRID)  # type: ignore[arg-type]
        for name, shape in shapes.items()
    }


@pytest.fixture(scope="module")
def inner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trained in the inner outfit."""
    folder = tmp_path_factory.mktemp("inner")
    subject = make_subject(folder)
    stage.run(subject, tiny(steps=8))
    return subject


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("outer"), _outer_layers(), _PITCH, _GRID).parent


@pytest.fixture
def subject(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared, tmp_path / "copy")
    return tmp_path / "copy" / "subject"


def _outfit(subject: Path) -> Outfit:
    workspace = Workspace(subject)
    return TrainedSubject.open(workspace.root).outfit()


def test_the_body_stays_to_the_bit_and_the_garments_learn(inner: Path, subject: Path) -> None:
    heard = Listener()
    before = Workspace(inner).require(TRAIN)
    result = stage.run(subject, tiny(steps=8), heard, from_subject=inner)
    after = result.artifact
    for name, values in before.arrays("body").items():
        assert np.array_equal(after.arrays("body")[name], values), name
    assert any("grid" in warning and "--pitch 20" in warning for warning in heard.warnings)
    assert result.summary["started"] == ["body", "upper"] and result.summary["frozen"] == ["body"]

    here, there = _outfit(subject), _outfit(inner)
    assert here.names == ("body", "upper", "outer")
    pictures = [
        render(compose({"body": outfit.posed(poses(), 3)["body"]}), cameras()[0]) for outfit in (here, there)
    ]
    assert pictures[0].alpha.max() > 0.5
    assert torch.equal(pictures[0].color, pictures[1].color)
    assert torch.equal(pictures[0].alpha, pictures[1].alpha)

    changed = {
        k for k, v in before.arrays("upper").items() if not np.array_equal(after.arrays("upper")[k], v)
    }
    assert {"base_color", "base_offset"} <= changed
    lines = [json.loads(line) for line in after.record("metrics.jsonl").splitlines()]
    told = lines[-1]["losses"]
    assert "penetration" in told and "label" in told
    assert not {"silhouette", "opacity", "covered_skin"} & told.keys(), "terms of the body alone"
    assert here.composite(poses(), 0).layers == ("body", "upper", "outer")


def test_layers_begin_as_they_were_and_the_body_has_neither_gradient_nor_moments(
    inner: Path, subject: Path
) -> None:
    trainer = stage.prepare(subject, tiny(), from_subject=inner)
    known = _outfit(inner)
    for frame in (0, 3):
        before, begun = known.posed(poses(), frame), trainer.posed(frame)
        assert torch.equal(begun["body"].means, before["body"].means)
        far = (begun["upper"].means - before["upper"].means).norm(dim=1)
        moved = before["upper"].offsets.norm(dim=1)
        assert far.max() < 0.2 * moved.max(), "anchors of the new take start with the offsets that were known"
        assert torch.allclose(begun["upper"].colors, before["upper"].colors, atol=0.05)
    assert trainer.parameters and not any(name.startswith("body.") for name in trainer.parameters)
    held = {id(p) for group in trainer.optimizer.param_groups for p in group["params"]}
    done = trainer.step(0, 0.0)
    assert done.finite
    for parameter in trainer.models["body"].parameters():
        assert parameter.grad is None and id(parameter) not in held
    assert trainer.models["upper"].base_color.grad is not None
    assert isinstance(trainer.config.weights, LossWeights) and trainer.config.weights.face == 0


def test_one_layer_alone_can_be_taken(inner: Path, subject: Path) -> None:
    trainer = stage.prepare(subject, tiny(from_layers=("body",)), from_subject=inner)
    ours = Workspace(subject).require(BAKE_MAPS)
    assert set(trainer.pretrained.decoders) == {"body"}
    assert len(trainer.models["upper"].maps) == len(ours.arrays("upper")["texels"])


def test_tracking_goes_on_from_what_is_known(inner: Path, subject: Path) -> None:
    config = tiny(track=TrackConfig(frame_step=1, cell=8, warm_up=2, rounds=1))
    trainer = stage.prepare(subject, config, from_subject=inner)
    assert trainer.tracker is not None
    assert isinstance(trainer.tracker.pretrained, PretrainedLayers)
    assert set(trainer.tracker.initial) == {"upper"} and np.abs(trainer.tracker.initial["upper"]).max() > 0
    kept = {name: trainer.models[name].base_color.detach().clone() for name in trainer.models}
    trainer.warm_up()
    assert torch.equal(trainer.models["upper"].base_color, kept["upper"]), "what is known is not warmed up"
    assert not torch.equal(trainer.models["outer"].base_color, kept["outer"])
    trainer.tracker.follow(0)
    start = trainer.tracker.start
    found = trainer.tracker.tracked["upper"].control_points[start]
    assert np.abs(found.numpy() - trainer.tracker.initial["upper"]).max() < 0.02
    assert torch.equal(trainer.models["body"].base_color, kept["body"])


def test_layers_on_two_grids_are_distilled_exported_and_worn(
    inner: Path, subject: Path, tmp_path: Path
) -> None:
    stage.run(subject, tiny(steps=1), from_subject=inner)
    distill.run(subject, DistillConfig(training_poses=4, blended_poses=4, most=(2, 2, 2)))
    played = TrainedSubject.open(subject, distilled=True).outfit()
    learned = _outfit(subject)
    for one, other in zip(played.layers, learned.layers, strict=True):
        assert one.maps.pitch == other.maps.pitch and len(one.maps) == len(other.maps)
    bundles = []
    for layer in ("body", "upper", "outer"):
        export_garment.run(subject, tmp_path / f"{layer}.gwg", ExportGarmentConfig(layer=layer))
        bundles.append((layer, read_bundle(tmp_path / f"{layer}.gwg")))
    grids = [bundle.manifest["grid"]["pitch"] for _, bundle in bundles]
    assert grids == pytest.approx([0.02, 0.02, _PITCH])
    worn, own = outfit_of_bundles(bundles).posed(poses(), 1), learned.posed(poses(), 1)
    for layer in ("upper", "outer"):
        assert torch.allclose(worn[layer].means, own[layer].means, atol=1e-4)


def test_an_interrupted_run_goes_on_to_the_bit(
    inner: Path, prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished = []
    step = Trainer.step

    def interrupted(self: Trainer, number: int, elapsed: float) -> StepReport:
        if number == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, number, elapsed)

    for name in ("whole", "split"):
        shutil.copytree(prepared, tmp_path / name)
        if name == "split":
            monkeypatch.setattr(Trainer, "step", interrupted)
            with pytest.raises(KeyboardInterrupt):
                stage.run(tmp_path / name / "subject", tiny(steps=5), from_subject=inner)
            monkeypatch.undo()
        done = stage.run(tmp_path / name / "subject", tiny(steps=5), from_subject=inner)
        finished.append({layer: done.artifact.arrays(layer) for layer in ("body", "upper", "outer")})
    for layer, arrays in finished[0].items():
        for name, values in arrays.items():
            assert np.array_equal(finished[1][layer][name], values), (layer, name)


def test_status_notices_another_training_of_the_other_subject(
    inner: Path, subject: Path, tmp_path: Path
) -> None:
    shutil.copytree(inner.parent, tmp_path / "other")
    other = tmp_path / "other" / "subject"
    stage.run(subject, tiny(steps=1), from_subject=other)
    assert _state(subject) == ("up to date", [])
    stage.run(other, tiny(steps=1))
    state, reasons = _state(subject)
    assert state == "stale" and any("from-subject" in reason for reason in reasons), reasons


def _state(subject: Path) -> tuple[str, list[str]]:
    found = staleness(Workspace(subject), PIPELINE)
    trained = next(one for one in found if one.stage == "train")
    reasons = [reason for reason in trained.reasons if "not made" not in reason]
    return trained.state, reasons


def test_a_plan_names_the_other_subject_and_counts_its_layers(inner: Path, subject: Path) -> None:
    planned = stage.plan(subject, tiny(), from_subject=inner)
    assert str(inner) in planned.inputs
    assert [name.rsplit("/", 1)[1] for name in planned.outputs] == [
        "body.safetensors", "upper.safetensors", "outer.safetensors"
    ]  # fmt: skip
    assert not (subject / "train").exists()


def test_layers_without_a_subject_to_take_them_from_are_refused(subject: Path) -> None:
    result = CliRunner().invoke(app, ["train", str(subject), "--from-layers", "body", "--dry-run"])
    assert result.exit_code == 2 and "Give --from-subject." in result.output


def test_what_cannot_be_a_start_is_refused(inner: Path, subject: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match="train has not been run"):
        stage.run(subject, tiny(), from_subject=make_subject(tmp_path / "untrained"))
    with pytest.raises(MissingInput, match="no trained layer 'outer'"):
        stage.run(subject, tiny(from_layers=("body", "outer")), from_subject=inner)
    with pytest.raises(MissingInput, match="no trained layer 'lower'"):
        stage.run(subject, tiny(from_layers=("lower",)), from_subject=inner)
    with pytest.raises(UsageProblem, match="itself"):
        stage.run(subject, tiny(), from_subject=subject)
    with pytest.raises(UsageProblem, match="baseline"):
        stage.run(subject, tiny(method="animatable-gaussians"), from_subject=inner)
    body = embedded_body()
    wider = replace(body, template_vertices=body.template_vertices * np.float32(1.01))
    with pytest.raises(UsageProblem, match="another body model"):
        stage.run(make_subject(tmp_path / "wider", body=wider), tiny(), from_subject=inner)
    alone = make_subject(tmp_path / "alone", {"body": tube_arrays(radius=0.12)})
    with pytest.raises(MissingInput, match="Nothing is left to learn"):
        stage.run(alone, tiny(), from_subject=inner)
    with pytest.raises(UsageProblem, match="anchors"):
        model = replace(tiny().model, anchors=0)
        stage.run(subject, tiny(model=model), from_subject=inner)
    assert Workspace(subject).current(TRAIN) is None
