"""What the scene requires, and what is left out of it and why."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.avatar.decoders.components import component_of
from stages.train import stage
from tests.stages.train.scene import make_subject, tiny


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("requirements"))


def test_a_scene_pays_for_what_it_shows(subject: Path) -> None:
    bare, full = tiny(), tiny()
    bare = replace(bare, model=replace(bare.model, networks="none", anchors=0))
    scenes = [stage.plan(subject, config).scene for config in (bare, full)]
    layers = list(scenes[0]["requires"])
    assert layers and list(scenes[1]["requires"]) == layers
    for name in layers:
        few, many = (scene["requires"][name]["multiply_adds_per_frame"] for scene in scenes)
        assert "networks" not in few and few.items() <= many.items()
        assert f"networks of {name}" in scenes[0]["left_out"]
    for name in {"body", "upper", "lower", "outer"} - set(layers):
        assert "the labels do not show it" in scenes[0]["left_out"][f"layer {name}"]
    assert scenes[0]["left_out"]["joints: left hand"].endswith("carried by the left wrist")
    assert {"view dependence", "LPIPS terms"} <= set(scenes[0]["left_out"])
    seeing = replace(full, model=replace(full.model, view_conditioning=True, heads="separate", history=2))
    left = stage.plan(subject, seeing).scene["left_out"]
    assert "view dependence" not in left and "recent motion" not in left


def test_dry_run_prints_it_and_the_manifest_keeps_it(subject: Path) -> None:
    words = ["train", str(subject), "--preset", "tiny", "--steps", "2", "--dry-run"]
    done = CliRunner().invoke(app, [*words, "--json"])
    told = json.loads(done.stdout.splitlines()[-1])["result"]["scene"]
    assert set(told) == {"requires", "left_out"} and told["requires"]["body"]["texels"] > 0
    people = CliRunner().invoke(app, words)
    assert "left out: view dependence: colours" in people.stderr
    assert "requires: body: " in people.stderr and not people.stdout
    result = stage.run(subject, tiny(steps=2))
    costs, left = result.summary["costs"], result.summary["left_out"]
    arrays = {name: result.artifact.arrays(f"{name}.safetensors") for name in costs}
    for name, cost in costs.items():
        assert sum(cost["bytes"].values()) == sum(array.nbytes for array in arrays[name].values())
        assert set(cost["bytes"]) == {component_of(tensor) for tensor in arrays[name]}
        wanted = told["requires"][name]["multiply_adds_per_frame"]
        assert cost["multiply_adds_per_frame"]["splatting at 512 x 512"] == wanted["splatting at 512 x 512"]
    assert "view dependence" in left
