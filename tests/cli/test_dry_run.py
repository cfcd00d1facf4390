"""`--dry-run` refuses what the real run refuses at once, in the same words, and writes nothing.

Every case is asked twice, as a plan and for real; a real run that begins to work instead of refusing shows
as another exit code.
"""

from __future__ import annotations

import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.artifacts.bundle import write_bundle
from tests.shared.capture.people import write_person
from tests.shared.outfit.wardrobe import bundle, make_subject, motion, worn

# Code, then the command. Names without a slash are of the folder that `place` makes; `out` does not exist.
REFUSED = """
66 import nowhere -o out
66 import foreign -o out
2 import foreign -o out --frames 9:3
66 register-template nowhere -o out
65 register-template file -o out
66 register-template foreign -o out
2 register-template person -o file
2 register-template person -o file/subject
2 register-template person -o out --template zz
2 register-template person -o out --preset zz
2 register-template person -o out --frame 99999
2 register-template person -o out --take zz
2 register-template person -o out --format zz
66 register-template person -o out --body-model nowhere
66 register-template person -o out --fit-body-model nowhere
66 register-template person -o out --virtual-cameras 12
2 register-template file -o out --virtual-cameras 12
2 register-template person -o out --fit --refine
66 label nowhere
66 label subject --strokes nowhere
65 label subject --strokes file
66 canonicalize nowhere
65 canonicalize file
65 canonicalize file -o out
2 canonicalize subject --spread zz
2 canonicalize subject -o out
66 segment-layers nowhere
65 segment-layers file
2 segment-layers subject --labels zz
66 bake-maps nowhere
66 bake-maps foreign
2 bake-maps subject --preset zz
66 train nowhere
2 train subject --method zz
2 train subject --without zz
2 train subject --device zz
2 train subject --decoder zz
2 train subject --networks zz
2 train subject --ranks zz
2 train subject --seed -1
66 train subject --perceptual-weights nowhere
65 train subject --perceptual-weights file
66 distill bare
2 distill subject --ranks zz
66 distill subject --poses nowhere
65 distill subject --poses file
66 fit-cloth bare
2 fit-cloth subject --materials zz
66 export-garment bare --layer lower -o out
66 export-garment subject --layer outer -o out
2 export-garment subject --layer zz -o out
2 export-garment subject --layer lower --slots zz -o out
2 export-garment subject --layer lower --precision zz -o out
66 export-garment subject --layer lower --distilled -o out
2 export-garment subject --layer lower -o foreign
2 export-garment subject --layer lower -o file/skirt.gwg
2 export-garment subject --layer lower -o out --poses motion.npz
66 export-garment subject --layer lower --mesh out.glb --poses nowhere
66 export-garment subject --layer outer --mesh out.glb
2 export-garment subject --layer lower --mesh out.obj
66 poses nowhere -o out
65 poses file -o out
2 poses motion.npz -o foreign
2 poses motion.npz -o out --frames 90:99
66 tryon body.gwg lower.gwg --poses nowhere -o out
65 tryon body.gwg lower.gwg --poses file -o out
66 tryon nowhere --poses motion.npz -o out
2 tryon lower.gwg --poses motion.npz -o out
2 tryon body.gwg lower.gwg lower.gwg --poses motion.npz -o out
2 tryon body.gwg --poses motion.npz -o foreign
2 tryon body.gwg --poses motion.npz -o file
2 tryon body.gwg --poses motion.npz -o file/film
2 tryon body.gwg --poses motion.npz -o out --camera zz
2 tryon body.gwg --poses motion.npz -o out --passes zz
2 tryon body.gwg --poses motion.npz -o out --background zz
2 tryon body.gwg --poses motion.npz -o out --betas zz
2 tryon body.gwg --poses motion.npz -o out --frames 90:99
2 tryon body.gwg --poses motion.npz -o out --shard 3/2
2 tryon body.gwg --poses motion.npz -o out --save-outfit foreign
66 tryon --poses motion.npz --tradeoff nowhere --quality 0.3 -o out
66 render body.gwg --poses nowhere -o out
66 render bare -o out
2 render subject -o foreign
2 render subject -o out --shard 0/2
2 render subject -o out --camera zz
2 render subject -o out --turns nan
2 render subject -o out --video zz
2 render subject -o out --export zz
2 render subject -o out --layers zz
66 render subject -o out --distilled
66 render subject -o out --cameras nowhere
2 render subject -o out --cameras capture --take zz
2 render subject -o out --html foreign
2 render subject --html file/a.html
66 view nowhere
66 view body.gwg --poses nowhere
2 view body.gwg --betas zz
66 view subject --distilled
66 evaluate nowhere
66 evaluate bare
66 evaluate subject --training zz
2 evaluate subject --split zz
2 evaluate subject --methods zz
66 evaluate subject --methods distilled
66 evaluate subject --perceptual-weights nowhere
65 evaluate subject --perceptual-weights file
2 evaluate subject -o foreign
2 evaluate subject -o out --shard 2/1
66 evaluate --frames foreign --truth capture
66 evaluate --images nowhere --truth capture
66 evaluate --images capture --truth capture --masks nowhere
2 evaluate --images capture --truth capture -o foreign
2 synth file --preset tiny
2 synth used --preset tiny
2 synth out --preset zz
2 synth out --preset tiny --seed -1
2 demo -o file --preset tiny
2 demo -o out --preset zz
2 demo -o out --device zz
2 demo -o out --steps 0
2 clean subject
66 bench curves nowhere
2 bench curves subject --methods zz
2 bench curves subject --without zz
2 bench curves subject --split zz
2 bench curves subject -o file
2 bench tradeoff capture -o file
2 bench tradeoff capture -o out --preset zz
2 bench tradeoff capture -o out --pitches zz
2 bench tradeoff capture -o out --pitches -1
66 bench tradeoff nowhere -o out
"""


@dataclass(frozen=True)
class Case:
    code: int
    words: tuple[str, ...]


CASES = [Case(int(line.split()[0]), tuple(shlex.split(line)[1:])) for line in REFUSED.split("\n") if line]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trained subject and its capture, an untrained one, a bare person, bundles, a motion, obstacles."""
    folder = tmp_path_factory.mktemp("place")
    make_subject(folder)
    (folder / "untrained").mkdir()
    make_subject(folder / "untrained", trained=False).rename(folder / "bare")
    write_person(folder / "person")
    for name in ("body", "lower"):
        write_bundle(folder / f"{name}.gwg", bundle(worn(name)))
    (folder / "motion.npz").write_bytes(motion().to_npz_bytes())
    (folder / "file").write_text("this is no mesh, no motion and no folder")
    for name in ("foreign", "used/subject_1"):
        (folder / name).mkdir(parents=True)
        (folder / name / "notes.txt").write_text("not to be lost")
    return folder


def everything(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize("case", CASES, ids=lambda case: " ".join(case.words).replace("/", "|"))
def test_a_plan_is_refused_as_the_run_is(case: Case, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parents[2])]))
    before = everything(place)
    plan = CliRunner().invoke(app, [*case.words, "--dry-run"])
    assert plan.exit_code == case.code, plan.stderr
    assert everything(place) == before
    run = CliRunner().invoke(app, list(case.words))
    assert run.exit_code == case.code, run.stderr
    errors = [[line for line in said.splitlines() if re.match(r"error:| where:|   fix:", line)]
              for said in (plan.stderr, run.stderr)]  # fmt: skip
    assert len(errors[0]) == 3 and without_dry_run(errors[0]) == without_dry_run(errors[1])
    assert not (place / "out").exists() or not any((place / "out").rglob("manifest.json"))


def without_dry_run(lines: list[str]) -> list[str]:
    """A command that runs another one repeats its words."""
    return [line.replace(" --dry-run", "") for line in lines]


def test_every_command_with_a_plan_is_asked() -> None:
    """A new command with --dry-run has to be added above."""
    import typer.main

    def planned(command: object, name: str) -> set[str]:
        inner = getattr(command, "commands", None)
        if inner:
            return {found for key, sub in inner.items() for found in planned(sub, f"{name} {key}".strip())}
        options = {option for p in command.params for option in p.opts}  # type: ignore[attr-defined]
        return {name} if "--dry-run" in options else set()

    asked = {" ".join(case.words[: 2 if case.words[0] == "bench" else 1]) for case in CASES}
    assert planned(typer.main.get_command(app), "") == asked
