"""Baselines and ablations: which layers and losses they have, and that they train, render and score."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.artifacts import Workspace
from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import LAYERS
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.train import stage
from stages.train.config import DEFAULT_METHOD, PARTS, PRESETS, LossWeights, TrainConfig, apply_ablation
from stages.train.methods import METHODS, clothing_layer, method_called, whole_layer
from stages.train.resolve import resolve_settings
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube_arrays
from tests.stages.train.scene import make_subject, poses, tiny

ZERO = torch.zeros(10)


@pytest.fixture(scope="module")
def tubes() -> dict[str, LayerMaps]:
    shapes = {
        "body": {"radius": 0.12},
        "upper": {"radius": 0.15, "low": -0.1, "high": 0.2, "color": (0.2, 0.5, 0.9)},
    }
    return {
        name: LayerMaps.from_arrays(name, tube_arrays(**shape), PITCH, CENTRE, GRID)  # type: ignore[arg-type]
        for name, shape in shapes.items()
    }


def test_the_whole_is_the_outermost_surface(tubes: dict[str, LayerMaps]) -> None:
    whole, ids = whole_layer(list(tubes.values()), ZERO)
    pixels = [set(layer.pixel_ids().tolist()) for layer in tubes.values()]
    assert whole.pixel_ids().tolist() == sorted(pixels[0] | pixels[1]), "one texel a pixel, in order"
    for index, pixel in enumerate(whole.pixel_ids().tolist()):
        layer = tubes["upper" if pixel in pixels[1] else "body"]
        own = layer.positions[layer.pixel_ids() == pixel][0]
        assert torch.equal(whole.positions[index], own) and LAYERS[ids[index]] == layer.layer
    back = LayerMaps.from_arrays("whole", whole.arrays(), PITCH, CENTRE, GRID)
    assert len(back) == len(whole)


def test_links_of_the_whole_join_layers_that_touch_and_no_others(tubes: dict[str, LayerMaps]) -> None:
    whole, ids = whole_layer(list(tubes.values()), ZERO)
    here, side = (whole.neighbours >= 0).nonzero(as_tuple=True)
    there = whole.neighbours[here, side]
    step = torch.tensor([[-1, 0], [0, 1], [1, 0], [0, -1]])[side]
    assert torch.equal(whole.texels[there, 1:], whole.texels[here, 1:] + step)
    assert torch.equal(whole.texels[there, 0], whole.texels[here, 0])
    depth = (whole.positions[there, 2] - whole.positions[here, 2]).abs()
    assert depth.max() <= max(0.03, 3 * PITCH)
    assert (ids[here] != ids[there]).any(), "across the hem"
    front, rear = whole.seams.unbind(dim=1)
    assert len(front) and torch.equal(whole.texels[front, 1:], whole.texels[rear, 1:])
    assert (whole.texels[front, 0] == 0).all() and (whole.texels[rear, 0] == 1).all()


def test_a_body_that_pokes_through_cloth_is_not_shown(tubes: dict[str, LayerMaps]) -> None:
    upper = tubes["upper"]
    front = torch.where(upper.texels[:, 0] == 0, 1.0, -1.0)
    for depth, hidden in ((0.02, True), (0.03, False)):  # cloth lies 1.5 cm outside the body
        sunk = replace(
            upper, positions=upper.positions - depth * front[:, None] * torch.tensor([0.0, 0.0, 1.0])
        )
        whole, ids = whole_layer([tubes["body"], sunk], ZERO)
        middle = (whole.texels[:, 2] - GRID // 2).abs() <= 1
        inside = middle & torch.isin(whole.pixel_ids(), upper.pixel_ids())
        assert bool((ids[inside] == LAYERS.index("upper")).all()) is hidden


def test_the_shape_stays_in_the_whole(tubes: dict[str, LayerMaps]) -> None:
    body = replace(tubes["body"], shape_directions=torch.rand(len(tubes["body"]), 10, 3))
    betas = torch.linspace(-1, 1, 10)
    whole, _ = whole_layer([body], betas)
    expected = body.positions + (betas[None, :, None] * body.shape_directions).sum(dim=1)
    assert torch.allclose(whole.positions, expected, atol=1e-6) and not whole.shape_directions.any()


def test_clothing_lies_on_the_covered_skin(tubes: dict[str, LayerMaps]) -> None:
    body, upper = tubes["body"], tubes["upper"]
    clothing, ids = clothing_layer(body, [upper])
    both = set(body.pixel_ids().tolist()) & set(upper.pixel_ids().tolist())
    assert clothing.pixel_ids().tolist() == sorted(both) and (ids == LAYERS.index("upper")).all()
    skin = body.positions[torch.isin(body.pixel_ids(), clothing.pixel_ids())]
    assert torch.allclose((clothing.positions - skin).norm(dim=1), torch.tensor(0.005), atol=1e-6)
    assert torch.equal(clothing.colors, upper.colors[torch.isin(upper.pixel_ids(), clothing.pixel_ids())])
    LayerMaps.from_arrays("clothing", clothing.arrays(), PITCH, CENTRE, GRID)
    far = replace(upper, texels=upper.texels + torch.tensor([0, 0, GRID // 3]))
    with pytest.raises(MissingInput):
        clothing_layer(body, [far])
    with pytest.raises(MissingInput):
        method_called("layga").layers({"body": body}, ZERO)


def test_labels_of_layers() -> None:
    clothing = METHODS["layga"].layer_of_label(("body", "clothing"))
    assert clothing == dict.fromkeys((0, 1, 2), "body") | dict.fromkeys((3, 4, 5), "clothing")
    shirt = METHODS[DEFAULT_METHOD].layer_of_label(("body", "upper"))
    assert shirt == dict.fromkeys((0, 1, 2), "body") | {3: "upper"}
    assert METHODS["animatable-gaussians"].layer_of_label(("whole",)) == {}


@pytest.mark.parametrize("method", sorted(METHODS.keys() - {DEFAULT_METHOD}))
def test_baselines_train_and_are_worn(method: str, tmp_path: Path) -> None:
    subject = make_subject(tmp_path)
    result = stage.run(subject, tiny(steps=10, method=method))
    summary = result.artifact.summary
    names = {"animatable-gaussians": ["whole"], "layga": ["body", "clothing"]}[method]
    assert summary["layers"] == names and summary["method"] == method
    losses = json.loads(result.artifact.record("metrics.jsonl").splitlines()[-1])["losses"]
    assert ("label" in losses) is ("penetration" in losses) is (method == "layga")
    workspace = Workspace(subject)
    outfit = TrainedSubject.open(workspace.root).outfit()
    composite = outfit.composite(poses(), 0)
    assert composite.layers == ("body", "upper") and composite.features.shape[1] == 5
    own = [torch.bincount(composite.layer_ids, minlength=2)[i].item() for i in range(2)]
    assert min(own) > 100 and sum(own) == summary["gaussians"]
    again = stage.run(subject, tiny(steps=10, method=method))
    assert again.artifact.key == result.artifact.key
    assert stage.run(subject, tiny(steps=2)).artifact.key != result.artifact.key


def test_every_part_switches_something_off_and_nothing_else() -> None:
    terms = {field.name for field in fields(LossWeights)}
    full = replace(PRESETS["draft"], weights=LossWeights(**dict.fromkeys(terms, 1.0)))
    gone: set[str] = set()
    for name in PARTS:
        less = apply_ablation(replace(full, without=(name,)))
        off = {term for term in terms if getattr(full.weights, term) != getattr(less.weights, term)}
        assert all(getattr(less.weights, term) == 0 for term in off)
        assert less != replace(full, without=(name,)) and apply_ablation(less) == less
        assert not off & gone, "a term belongs to one part"
        gone |= off
    assert gone == terms - {"l1"}
    assert apply_ablation(full) == full
    assert not apply_ablation(replace(full, without=("sg",))).track.labels
    assert full.track.collision and not apply_ablation(replace(full, without=("pe",))).track.collision


def test_ablation_is_in_the_key_and_silences_the_term(tmp_path: Path) -> None:
    subject = make_subject(tmp_path)
    result = stage.run(subject, tiny(steps=2, without=("sg", "reg")))
    losses = json.loads(result.artifact.record("metrics.jsonl").splitlines()[-1])["losses"]
    assert not {"label", "offset", "smooth", "seam", "opacity"} & losses.keys() and "silhouette" in losses
    assert result.artifact.summary["without"] == ["sg", "reg"]
    assert result.artifact.config["without"] == ["sg", "reg"]


def test_settling_twice_changes_nothing_and_unknown_names_are_refused() -> None:
    for method in METHODS:
        once = resolve_settings(TrainConfig(method=method, without=("pe",)))
        assert resolve_settings(once) == once and once.weights.penetration == 0
    for wrong in (TrainConfig(method="magic"), TrainConfig(without=("magic",))):
        with pytest.raises(UsageProblem, match="magic"):
            resolve_settings(wrong)


def test_help_names_every_part_and_method() -> None:
    text = CliRunner().invoke(app, ["train", "--help"], env={"COLUMNS": "200"}).output
    words = set(re.findall(r"[\w-]+", text))
    assert words >= {*PARTS, *METHODS}


def test_commands_refuse_unknown_names(tmp_path: Path) -> None:
    subject = str(make_subject(tmp_path))
    for wrong in (["--method", "magic"], ["--without", "sg,magic"]):
        assert CliRunner().invoke(app, ["train", subject, *wrong]).exit_code == 2
    done = CliRunner().invoke(
        app, ["train", subject, "--preset", "tiny", "--without", "sg,pe", "--dry-run", "--json"]
    )
    assert done.exit_code == 0, done.stderr
    assert '"without": ["sg", "pe"]' in done.stdout and np.isfinite(len(done.stdout))
