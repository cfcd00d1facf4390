"""`gw inspect`, `gw wardrobe`, and dressing from a wardrobe or an outfit file."""

from __future__ import annotations

import json
import os
import shutil
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.artifacts.bundle import read_bundle, read_card, write_bundle
from stages.shared.outfit.describe import fit
from stages.shared.outfit.wardrobe import add_piece, count_outfits, pieces, sensible_outfits
from tests.hostile.forge import forged
from tests.shared.outfit.wardrobe import bundle, worn


def run(*words: object, code: int = 0) -> dict[str, Any]:
    """The result of a command with --json; of a failing one its three lines."""
    found = CliRunner().invoke(app, [*map(str, words), "--json"])
    assert found.exit_code == code, (words, found.output, found.stderr)
    if code:
        assert len(found.stderr.strip().splitlines()) == 3, found.stderr
        return {"error": found.stderr}
    return dict(json.loads(found.stdout.splitlines()[-1])["result"])


@pytest.fixture
def closet(wardrobe: Path, tmp_path: Path) -> Path:
    """A wardrobe made by the command."""
    folder = tmp_path / "closet"
    run("wardrobe", "add", folder, *(wardrobe / f"{name}.gwg" for name in ("body", "lower", "upper")))
    return folder


def test_inspect_says_what_the_file_holds(wardrobe: Path, tmp_path: Path) -> None:
    path = wardrobe / "upper.gwg"
    shown, whole = run("inspect", path, "--tensors", "--preview", tmp_path / "p.png"), read_bundle(path)
    assert (shown["kind"], shown["slots"], shown["digest"]) == ("garment", ["upper"], whole.digest)
    assert shown["gaussians"] == len(whole.arrays["maps/positions"]) and shown["bytes"] == path.stat().st_size
    assert shown["half_precision"] and shown["carries_body_beneath"]
    sizes = {name: array.nbytes for name, array in whole.arrays.items()}
    assert sum(shown["bytes_by_group"].values()) == sum(sizes.values())
    assert shown["bytes_by_group"]["swap"] == sum(n for name, n in sizes.items() if name.startswith("swap/"))
    assert sum(shown["model_bytes_by_component"].values()) == shown["bytes_by_group"]["model"]
    assert set(shown["tensors"]) == set(sizes)
    picture = cv2.imread(str(tmp_path / "p.png"))[..., ::-1]
    assert np.array_equal(picture, whole.arrays["preview"])
    people = CliRunner().invoke(app, ["inspect", str(path)])
    assert people.exit_code == 0 and "slots: upper" in people.stderr and not people.stdout


def test_inspect_reads_the_header_only_and_verify_reads_all(wardrobe: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.gwg"
    data = bytearray((wardrobe / "upper.gwg").read_bytes())
    data[-1] ^= 1
    damaged.write_bytes(data)
    assert run("inspect", damaged)["kind"] == "garment"
    run("verify", damaged, code=65)
    assert run("verify", wardrobe / "upper.gwg")["damaged"] == []
    damaged.write_bytes(data[:200])
    run("inspect", damaged, code=65)
    run("inspect", tmp_path / "none.gwg", code=66)


def test_list_shows_pieces_and_what_fits(closet: Path) -> None:
    (closet / "broken.gwg").write_bytes(b"nothing")
    shown = {piece["name"]: piece for piece in run("wardrobe", "list", closet)["pieces"]}
    assert set(shown) == {"body", "lower", "upper", "broken"}
    assert "cannot be used" in shown["broken"]["problem"]
    assert shown["upper"]["on"] == {"body": "own"} and "on" not in shown["body"]
    people = CliRunner().invoke(app, ["wardrobe", "list", str(closet)])
    assert "cannot be used" in people.stderr and "body own" in people.stderr
    run("wardrobe", "list", closet / "none", code=66)


def test_fit_and_sensible_outfits(tmp_path: Path) -> None:
    cards = {}
    for name, made in {
        "body": bundle(worn("body", source="one")),
        "own": bundle(worn("upper", source="one")),
        "other": bundle(worn("upper", source="two")),
        "far": bundle(worn("lower"), digest="cd" * 32),
        "dress": bundle(worn("lower"), slots=("lower", "upper")),
    }.items():
        write_bundle(tmp_path / f"{name}.gwg", made)
        cards[name] = read_card(tmp_path / f"{name}.gwg")
    assert [fit(cards[name], cards["body"]) for name in ("own", "other", "far")] == ["own", "fits", "no"]
    names = {tuple(piece.name for piece in worn_) for worn_ in sensible_outfits(pieces(tmp_path))}
    # `far` does not fit, `dress` takes both slots, two uppers exclude each other.
    assert count_outfits(pieces(tmp_path)) == len(names)
    assert names == {("body",), ("body", "dress"), ("body", "other"), ("body", "own")}


def test_add_checks_and_keeps_what_is_there(closet: Path, wardrobe: Path, tmp_path: Path) -> None:
    assert (closet / "upper.gwg").read_bytes() == (wardrobe / "upper.gwg").read_bytes()
    assert (closet / "previews/upper.png").is_file()
    run("wardrobe", "add", closet, wardrobe / "upper.gwg")  # the same again is nothing new
    run("wardrobe", "add", closet, wardrobe / "lower.gwg", "--name", "upper", code=2)
    run("wardrobe", "add", closet, wardrobe / "lower.gwg", "--name", "../up", code=2)
    (tmp_path / "bad.gwg").write_bytes((wardrobe / "upper.gwg").read_bytes()[:-1])
    run("wardrobe", "add", closet, tmp_path / "bad.gwg", code=65)
    assert not (closet / "bad.gwg").exists() and not (tmp_path / "up.gwg").exists()


def test_remove_by_name_or_digest(closet: Path) -> None:
    digest = read_card(closet / "lower.gwg").digest
    run("wardrobe", "remove", closet, digest[:10])
    assert not (closet / "lower.gwg").exists() and not (closet / "previews/lower.png").exists()
    run("wardrobe", "remove", closet, "lower", code=66)
    run("wardrobe", "remove", closet, "upper")
    assert [piece.name for piece in pieces(closet)] == ["body"]


def test_tryon_from_a_wardrobe_and_from_an_outfit_file(closet: Path, wardrobe: Path, tmp_path: Path) -> None:
    motion = ["--poses", wardrobe / "motion.npz", "--preset", "tiny", "--frames", "2:3"]
    plain = run("tryon", wardrobe / "body.gwg", wardrobe / "upper.gwg", *motion, "-o", tmp_path / "a")
    named = run(
        *("tryon", "--wardrobe", closet, "--outfit", "body,upper", *motion, "-o", tmp_path / "b"),
        *("--save-outfit", tmp_path / "o.json", "--betas", "1,-0.5", "--drive", "upper=bones"),
    )
    saved = json.loads((tmp_path / "o.json").read_text())
    assert [piece["name"] for piece in saved["pieces"]] == ["body", "upper"]
    assert saved["drive"] == "upper=bones"
    assert str(tmp_path) not in (tmp_path / "o.json").read_text()
    (closet / "upper.gwg").rename(closet / "renamed.gwg")  # found by digest, not by name
    again = run(
        *("tryon", "--wardrobe", closet, "--outfit", tmp_path / "o.json", *motion, "-o", tmp_path / "c")
    )
    assert plain["bundles"] == named["bundles"] == again["bundles"] and again["betas"] == named["betas"]
    frames = [(tmp_path / folder / "frames/000002.png").read_bytes() for folder in "abc"]
    assert frames[1] == frames[2] != frames[0]
    (tmp_path / "o.json").write_text(json.dumps({**saved, "drive": "hat=bones"}))
    wrong = ("tryon", "--wardrobe", closet, "--outfit", tmp_path / "o.json", *motion, "-o", tmp_path / "d")
    assert "no garment 'hat'" in run(*wrong, code=2)["error"]
    own = run(*wrong, "--drive", "learned")  # an option goes before the file
    assert own["bundles"] == again["bundles"]


def test_an_outfit_whose_piece_changed_is_refused(closet: Path, wardrobe: Path, tmp_path: Path) -> None:
    motion = ["--poses", wardrobe / "motion.npz", "--preset", "tiny", "-o", tmp_path / "out"]
    outfit = closet / "o.json"
    run(
        *("tryon", "--wardrobe", closet, "--outfit", "body,upper", *motion, "--frames", "0:1"),
        *("--save-outfit", outfit),
    )
    shutil.copyfile(closet / "lower.gwg", closet / "upper.gwg")
    assert "holds something else" in run("tryon", "--outfit", outfit, *motion, code=66)["error"]
    piece = f'{{"name":"x","digest":"{"0" * 64}"}}'
    for text in ("", "{}", '{"format":"gw-outfit","version":2}', "[" * 100_000, '{"format":NaN}',
                 '{"format":"gw-outfit","version":1,"pieces":[{"name":"x","digest":"../x"}]}',
                 f'{{"format":"gw-outfit","version":1,"drive":7,"pieces":[{piece}]}}'):  # fmt: skip
        outfit.write_text(text)
        run("tryon", "--outfit", outfit, *motion, code=65)
    run("tryon", "--outfit", tmp_path / "none.json", *motion, code=66)
    run("tryon", "--wardrobe", closet, "--outfit", "body,hat", *motion, code=66)
    run("tryon", "--outfit", "body", *motion, code=2)
    run("tryon", *motion, code=2)
    run("tryon", closet / "body.gwg", "--wardrobe", closet, *motion, code=2)


def test_all_outfits_on_one_sheet(closet: Path, tmp_path: Path) -> None:
    shown = run("wardrobe", "outfits", closet, "-o", tmp_path / "all", "--width", 48, "--height", 64)
    assert shown["outfits"] == 4
    rows = json.loads((tmp_path / "all/outfits.json").read_text())["all"]
    assert {tuple(row["layers"]) for row in rows} == {
        ("body",), ("body", "lower"), ("body", "upper"), ("body", "lower", "upper"),
    }  # fmt: skip
    assert cv2.imread(str(tmp_path / "all/outfits.png")).shape[1] == 4 * 96
    run("wardrobe", "outfits", closet, "-o", tmp_path / "none", "--most", 3, code=2)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("garments", [20, 60])
def test_outfits_of_many_garments_for_one_slot_are_counted_at_once(
    garments: int, wardrobe: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "many"
    folder.mkdir()
    shutil.copyfile(wardrobe / "body.gwg", folder / "body.gwg")
    for index in range(garments):
        shutil.copyfile(wardrobe / "upper.gwg", folder / f"g{index:02d}.gwg")
    assert count_outfits(pieces(folder)) == garments + 1
    error = run("wardrobe", "outfits", folder, "-o", tmp_path / "out", "--most", 10, code=2)["error"]
    assert f"{garments + 1} outfits" in error


def test_counted_outfits_are_those_that_are_listed(wardrobe: Path, tmp_path: Path) -> None:
    write_bundle(tmp_path / "dress.gwg", bundle(worn("lower"), slots=("lower", "upper")))
    write_bundle(tmp_path / "coat.gwg", bundle(worn("outer"), slots=("upper", "outer")))
    for name in ("body", "lower", "upper"):
        shutil.copyfile(wardrobe / f"{name}.gwg", tmp_path / f"{name}.gwg")
        shutil.copyfile(wardrobe / f"{name}.gwg", tmp_path / f"{name}2.gwg")
    catalogue = pieces(tmp_path)
    listed = list(sensible_outfits(catalogue))
    assert count_outfits(catalogue) == len(listed) == len({tuple(p.name for p in worn_) for worn_ in listed})
    for outfit in listed:
        slots = [slot for piece in outfit if piece.card for slot in piece.card.manifest["slots"]]
        assert len(slots) == len(set(slots))


def test_one_of_two_adds_of_one_name_wins(closet: Path, wardrobe: Path) -> None:
    """Whoever comes while another process adds is refused, and whoever comes later finds the name taken."""
    from stages.shared.artifacts.lock import holding

    held, release = threading.Event(), threading.Event()

    def other() -> None:
        with holding(closet):
            held.set()
            release.wait(10)

    process = threading.Thread(target=other)
    process.start()
    held.wait(10)
    run("wardrobe", "add", closet, wardrobe / "lower.gwg", "--name", "thing", code=75)
    run("wardrobe", "remove", closet, "lower", code=75)
    release.set()
    process.join()
    run("wardrobe", "add", closet, wardrobe / "lower.gwg", "--name", "thing")
    run("wardrobe", "add", closet, wardrobe / "upper.gwg", "--name", "thing", code=2)
    assert read_card(closet / "thing.gwg").digest == read_card(wardrobe / "lower.gwg").digest


def test_left_overs_of_a_killed_add_are_removed(closet: Path, wardrobe: Path) -> None:
    left = [closet / ".vest.gwg.tmp-0123456789ab", closet / "previews/.vest.png.tmp-ba9876543210"]
    mine = [closet / ".notes.tmp-mine", closet / "previews/.keep"]
    for path in (*left, *mine):
        path.write_bytes(b"half")
    assert add_piece(closet, wardrobe / "lower.gwg", "vest").name == "vest"
    assert not any(path.exists() for path in left) and all(path.exists() for path in mine)


BAD_CARDS: dict[str, Any] = {
    "scores a list": {"training": {"scores": [1, 2]}},
    "score not finite": {"training": {"scores": {"psnr": 1e400}}},
    "source a number": {"training": {"source": 3}},
    "costs a text": {"costs": "cheap"},
    "model without texels": {"model": {}},
    "model decoder": {"model": {"decoder": ["x"], "texels": 4}},
    "body model a list": {"body_model": []},
}


@pytest.mark.parametrize("case", BAD_CARDS)
def test_one_bad_file_does_not_hide_the_others(case: str, closet: Path, wardrobe: Path) -> None:
    bad = closet / "bad.gwg"
    bad.write_bytes(forged(read_bundle(wardrobe / "upper.gwg"), BAD_CARDS[case]))
    assert "error" in run("inspect", bad, code=65) and "error" in run("verify", bad, code=65)
    shown = {piece["name"]: piece for piece in run("wardrobe", "list", closet)["pieces"]}
    assert "problem" in shown["bad"] and {"body", "lower", "upper"} <= {
        name for name, piece in shown.items() if "problem" not in piece
    }


@pytest.mark.parametrize("missing", ["maps/texels", "betas", "preview", "maps/skin_weights"])
def test_inspect_refuses_a_file_without_a_tensor_that_every_bundle_has(
    missing: str, closet: Path, wardrobe: Path
) -> None:
    bundle_ = read_bundle(wardrobe / "upper.gwg")
    arrays = {name: array for name, array in bundle_.arrays.items() if name != missing}
    (closet / "bad.gwg").write_bytes(forged(replace(bundle_, arrays=arrays), {}))
    assert missing in run("inspect", closet / "bad.gwg", code=65)["error"]
    assert any("problem" in piece for piece in run("wardrobe", "list", closet)["pieces"])


def test_pipes_and_folders_are_no_bundles(closet: Path) -> None:
    os.mkfifo(closet / "pipe.gwg")
    (closet / "folder.gwg").mkdir()
    shown = {piece["name"]: piece for piece in run("wardrobe", "list", closet)["pieces"]}
    assert "pipe or a device" in shown["pipe"]["problem"] and "problem" in shown["folder"]
    run("inspect", closet / "pipe.gwg", code=65)
