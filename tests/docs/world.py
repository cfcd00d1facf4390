"""A folder with all files that the commands of the documentation name, and a function that runs them."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from gw_cli.app import app
from stages.pipeline import TRAIN
from stages.shared.artifacts import Workspace
from stages.shared.body import Poses
from stages.workflows.tradeoff.config import BenchTradeoffConfig
from stages.workflows.tradeoff.front import OperatingPoint
from stages.workflows.tradeoff.stage import write_results
from tests.docs.pages import REPOSITORY, blocks
from tests.shared.poses.test_bvh import motion as bvh_motion
from tests.shared.poses.test_bvh import write as write_bvh

SUBJECTS = ("SUBJECT", "SUBJECT_A", "SUBJECT_B", "anna")
BUNDLES = {"body": ("body", "anna"), "lower": ("skirt",), "upper": ("shirt",)}
MOTIONS = ("motion", "walk", "dance", "run", "fit")
# Options that make commands small. The last value of an option counts.
SMALL = {
    "export-garment": "--preset tiny",
    "tryon": "--preset tiny --frames 0:2 --width 32 --height 48",
    "render": "--preset tiny --frames 0:2 --width 32 --height 48",
    "evaluate": "--preset tiny --cameras 1",
    "wardrobe outfits": "--width 24 --height 32",
    "bench paper": "--cameras 1 --test-frame-step 2",
}


def furnish(folder: Path, subject: Path, capture: Path, bundles: Path, poses: Poses) -> None:
    """Copy the inputs to the names that the documentation uses.

    Arguments:
        subject: a trained subject. capture: its capture. bundles: folder with body.gwg, lower.gwg, upper.gwg.
    """
    shutil.copytree(capture, folder / "CAPTURE")
    for name in SUBJECTS:
        shutil.copytree(subject, folder / name)
        Workspace(folder / name).save_settings(capture=folder / "CAPTURE")
    (folder / "wardrobe").mkdir()
    for layer, names in BUNDLES.items():
        shutil.copy(bundles / f"{layer}.gwg", folder / "wardrobe")
        for name in names:
            shutil.copy(bundles / f"{layer}.gwg", folder / f"{name}.gwg")
    for name in MOTIONS:
        poses.save(folder / f"{name}.npz")
    angles, roots = bvh_motion(3)
    write_bvh(folder / "walk.bvh", angles, roots)
    np.savez(
        folder / "walk_poses.npz", poses=np.zeros((6, 156)), trans=np.zeros((6, 3)), mocap_framerate=120.0
    )
    pictures = next((capture / "takes").glob("*/rgb/*")), next((capture / "takes").glob("*/masks/*"))
    for name, source in (("renders", pictures[0]), ("photos", pictures[0]), ("masks", pictures[1])):
        shutil.copytree(source, folder / name)
    (json_block,) = [block for block in blocks(REPOSITORY / "docs/rendering.md") if block.kind == "json"]
    (folder / "path.json").write_text(json_block.text)
    _measured(folder / "tradeoff", bundles)


def _measured(folder: Path, bundles: Path) -> None:
    """A result folder of `gw bench tradeoff` with one operating point."""
    scores = {"psnr_foreground": 17.0, "ssim_foreground": 0.8, "miou": 0.9, "sharpness": 0.5}
    point = OperatingPoint(
        name="one", pitch=6.5, decoder="as trained", gaussians=900, **scores, novel_pose=scores,
        frames_per_second=30.0, training_minutes=5.0, bundle_bytes=10**6, peak_bytes=10**8,
    )  # fmt: skip
    shutil.copytree(bundles, folder / "points" / "one")
    write_results(folder, "subject", [point], BenchTradeoffConfig())


def parts(line: str, folder: Path) -> list[list[str]]:
    """Words after `gw` of every command in a line, with placeholders replaced."""
    found = []
    for part in line.split("&&"):
        words = shlex.split(part)
        assert words[0] == "gw", line
        found.append([_in_place(word, words[1], folder) for word in words[1:]])
    return found


def _in_place(word: str, command: str, folder: Path) -> str:
    """Replace OUT by a folder per command, and the key of a training by an existing key."""
    if word == "OUT":
        return f"OUT-{command}"
    if re.fullmatch(r"[0-9a-f]{6}", word):
        return Workspace(folder / "SUBJECT").require(TRAIN).key[:6]
    return word


def name_of(words: list[str]) -> str:
    """ "tryon", "bench paper" and so on."""
    return " ".join(words[: 2 if words[0] in ("bench", "wardrobe") else 1])


def run(words: list[str]) -> None:
    """Run a command in this process. A failure shows its output."""
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, f"gw {shlex.join(words)}: {done.exit_code} {done.stderr} {done.exception!r}"
