"""Every block of README and docs runs, page by page, in the order of the page.

A tiny subject made of tubes replaces the reader's. Commands that take long, or need the whole pipeline, run
with `--dry-run` here. The long version runs them on a synthetic person.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.label.strokes import read_strokes
from stages.shared.capture import native_writer, open_capture
from stages.shared.capture.native import read_cameras
from stages.shared.poses import load_poses
from stages.shared.render_sequence.camera_path import path_cameras
from tests.docs.pages import PAGES, REPOSITORY, blocks
from tests.docs.world import SMALL, furnish, name_of, parts, run
from tests.shared.outfit.wardrobe import motion

DOCS = REPOSITORY / "docs"
# Tested elsewhere: name of the program to the test.
ELSEWHERE = {
    "make": "each of its targets is a line of .ci/run, or one `gw` call",
    "python": "tests/benchmarks has a test of every benchmark",
    "torchrun": "tests/stages/train/test_distributed.py starts the processes",
    "snakemake": "tests/stages/workflows/test_snakefile.py plans and runs the emitted file",
}
PLANNED = ("train", "bench curves", "bench tradeoff", "view")  # --dry-run here
# These need the artifacts of every stage, or the true meshes of a simulated capture.
WHOLE_CHAIN = (
    "register-template", "label", "canonicalize", "segment-layers", "bake-maps", "fit-cloth", "--true-meshes",
)  # fmt: skip
NO_RECORDINGS = ("import",)  # tests/stages/import_capture makes videos and pictures, and imports them
SHORT = {
    "register-template": "--preset tiny",
    "canonicalize": "--preset tiny",
    "segment-layers": "--preset tiny",
    "bake-maps": "--preset tiny",
    "train": "--preset tiny --minutes 0 --steps 3",
    "fit-cloth": "--preset tiny",
    "bench curves": "--preset tiny --minutes 0.02 --points 1 --cameras 1",
    "bench tradeoff": "--preset tiny --minutes 0.1 --pitches 25 --size 32",
    "view": "--dry-run",  # serves until it is interrupted: tests/stages/view opens it in a browser
}
DRAWN = {("README.md", "bibtex"), ("architecture.md", "mermaid")}  # not input of gw
TAKES = ("train", "held_out")  # of a synthetic person
SHELL = [(page, block) for page in PAGES for block in blocks(page) if block.kind == "shell"]


def lines(page: Path) -> list[str]:
    """Command lines of a page that run in this test."""
    shown = [line for own, block in SHELL if own == page for line in block.commands]
    return [line for line in shown if line.split()[0] not in ELSEWHERE]


def test_every_block_is_of_a_kind_that_is_tested() -> None:
    kinds = {(block.page, block.kind) for page in PAGES for block in blocks(page) if block.kind != "shell"}
    assert kinds - DRAWN == {
        ("formats.md", ""),
        ("formats.md", "json"),
        ("rendering.md", "json"),
        ("python-api.md", "python"),
        ("scale.md", "yaml"),
        ("splatting.md", "python"),
    }
    assert {block.page for _, block in SHELL} >= {"README.md", "evaluation.md", "wardrobe.md"}
    assert len(lines(REPOSITORY / "README.md")) >= 10


@pytest.mark.parametrize("page", sorted({own for own, _ in SHELL}), ids=lambda page: page.name)
def test_the_commands_run(
    page: Path,
    dressed_subject: Path,
    wardrobe: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    furnish(tmp_path, dressed_subject, dressed_subject.parent / "capture", wardrobe, motion())
    monkeypatch.chdir(tmp_path)
    for line in lines(page):
        for words in parts(line, tmp_path):
            if not {*WHOLE_CHAIN, *NO_RECORDINGS} & {name_of(words), *words}:
                dry = "--dry-run" if name_of(words) in PLANNED else ""
                run([*words, *SMALL.get(name_of(words), dry).split()])


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_the_commands_run_on_a_whole_chain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every page, without dry runs, on a synthetic person that the README's commands make."""
    monkeypatch.chdir(tmp_path)
    run(["synth", "people", "--preset", "tiny"])
    shutil.copytree("people/subject_1", "CAPTURE")
    shutil.copy("people/motions/held_out.npz", "motion.npz")
    _in_full(REPOSITORY / "README.md", tmp_path)
    run(["export-garment", "SUBJECT", "--layer", "upper", "-o", "upper.gwg", "--preset", "tiny"])
    (tmp_path / "bundles").mkdir()
    for name, layer in (("body", "body"), ("skirt", "lower"), ("upper", "upper")):
        shutil.copy(f"{name}.gwg", f"bundles/{layer}.gwg")
    poses = load_poses(Path("motion.npz"))[:12]
    for page in sorted({own for own, _ in SHELL if own.name != "README.md"}):
        folder = tmp_path / page.stem
        folder.mkdir()
        furnish(folder, tmp_path / "SUBJECT", tmp_path / "CAPTURE", tmp_path / "bundles", poses)
        for name, take in zip("ab", TAKES, strict=True):
            shutil.copy(tmp_path / f"CAPTURE/takes/{take}/gt/meshes.npz", folder / f"{name}.npz")
        monkeypatch.chdir(folder)
        _in_full(page, folder)


def _in_full(page: Path, folder: Path) -> None:
    for line in lines(page):
        for command in parts(line, folder):
            if name_of(command) in NO_RECORDINGS:
                continue
            words = [
                word.replace("Sequence1=", "train=").replace("Sequence2=", "held_out=") for word in command
            ]
            more = {**SMALL, **SHORT}.get(name_of(words), "").split()
            # This test does not depend on the frame rate of the machine or the time of a whole preset.
            more += ["--fps", "0.1"] if {"--tradeoff", "--fps"} <= set(words) else []
            more += ["--also", "tiny:0.1"] if "--also" in words else []
            more += ["--frames", ""] if "--cameras" in words and name_of(words) == "render" else []  # its own
            run([*words, *more])


def json_blocks(page: str) -> list[str]:
    return [block.text for block in blocks(DOCS / page) if block.kind == "json"]


def test_the_native_capture_and_strokes_that_are_shown_are_read(tmp_path: Path) -> None:
    about, calibration, strokes = json_blocks("formats.md")
    strokes_path = tmp_path / "strokes.json"
    strokes_path.write_text(strokes)
    assert [stroke.view for stroke in read_strokes(strokes_path)] == ["cam03", None]
    cameras_path = tmp_path / "calibration.json"
    cameras_path.write_text(calibration)
    cameras, held_out = read_cameras(cameras_path)
    assert list(cameras) == ["cam0"] and not held_out
    folder = tmp_path / "capture"
    takes = json.loads(about)["takes"]
    with native_writer(folder, cameras.values()) as writer:
        for take in takes:
            written = writer.take(take["name"], take.get("split", "train"), motion(2))
            for frame in range(2):
                picture = np.zeros((cameras["cam0"].height, cameras["cam0"].width, 3), np.uint8)
                written.view("cam0", frame, picture, picture[..., 0] + 255)
    (folder / "capture.json").write_text(about)
    capture = open_capture(folder)
    assert {take.name: take.split for take in capture.takes} == {
        take["name"]: take["split"] for take in takes
    }
    assert [take.fps for take in capture.takes] == [take["fps"] for take in takes]


def test_the_files_that_are_shown_are_those_of_a_capture(dressed_subject: Path) -> None:
    """Files that are not optional exist, and every file that exists is on the page."""
    (shown,) = [block for block in blocks(DOCS / "formats.md") if block.kind == ""]
    listed: dict[str, bool] = {}
    below = ""
    for line in shown.text.splitlines():
        name, _, about = line.strip().partition("  ")
        below = name if name.endswith("/") else below if line.startswith(" ") else ""
        if not name.endswith("/"):
            listed[below + name.partition(".")[0]] = about.strip().startswith("optional")
    capture = dressed_subject.parent / "capture"
    there = {_pattern(path.relative_to(capture)) for path in capture.rglob("*") if path.is_file()}
    assert {name for name, optional in listed.items() if not optional} <= there <= set(listed)


def _pattern(path: Path) -> str:
    """takes/moves/rgb/cam0/000001.png -> takes/<take>/rgb/<camera>/<frame>"""
    words = list(path.with_suffix("").parts)
    if words[0] == "takes":
        words[1] = "<take>"
        words[3:] = ["<camera>", "<frame>"] if len(words) == 5 else words[3:]
    return "/".join(words)


def test_the_camera_path_that_is_shown_is_read(tmp_path: Path) -> None:
    (path,) = json_blocks("rendering.md")
    (tmp_path / "path.json").write_text(path)
    cameras = path_cameras(tmp_path / "path.json", 91, (64, 64))
    assert cameras[0].centre.tolist() == pytest.approx([0, 1.2, 3])
    assert cameras[90].centre.tolist() == pytest.approx([3, 1.2, 0])


def test_the_profile_that_is_shown_is_yaml() -> None:
    yaml = pytest.importorskip("yaml", reason="comes with snakemake (extra `cluster`)")
    (profile,) = [block.text for block in blocks(DOCS / "scale.md") if block.kind == "yaml"]
    assert {"executor", "jobs", "default-resources"} <= set(yaml.safe_load(profile))


def test_the_program_that_is_shown_runs() -> None:
    (program,) = [block.text for block in blocks(DOCS / "splatting.md") if block.kind == "python"]
    names: dict[str, object] = {}
    exec(compile(program, "docs/splatting.md", "exec"), names)
    assert names["picture"].features.shape == (256, 256, 3)  # type: ignore[attr-defined]
    assert 0.5 < float(names["picture"].alpha.max()) < 1  # type: ignore[attr-defined]


def test_a_bundle_is_opened_posed_and_rendered_from_python(
    dressed_subject: Path, wardrobe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (program,) = [block.text for block in blocks(DOCS / "python-api.md") if block.kind == "python"]
    furnish(tmp_path, dressed_subject, dressed_subject.parent / "capture", wardrobe, motion())
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "docs/python-api.md", "exec"), {})
    picture = cv2.imread("frame.png")
    assert picture is not None and picture.shape == (320, 240, 3)
    assert 0.02 < (picture.min(axis=2) < 250).mean() < 0.9, "a person before white"
