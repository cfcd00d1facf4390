"""A wardrobe: a folder of bundles, one file a piece; and outfit files, which name pieces by digest.

DIR/NAME.gwg            a body or a garment
DIR/previews/NAME.png   (H, W, 3) u8, its picture
outfit.json             {"format": "gw-outfit", "version": 1, "pieces": [{"name", "digest"}],
                         "betas", "drive"}
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.shared.artifacts.bundle import BundleCard, decode_bundle, read_bundle_bytes, read_card
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.files import make_folders, write_whole
from stages.shared.artifacts.lock import holding
from stages.shared.artifacts.pictures import encode_png
from stages.shared.artifacts.temporary import sweep_files
from stages.shared.errors import BadData, GwError, MissingInput, UsageProblem
from stages.shared.input_files import read_json
from stages.shared.outfit.describe import fit

OUTFIT_FORMAT = "gw-outfit"
_LONGEST_DRIVE = 200
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_MAX_OUTFIT_BYTES = 1 << 16
_MAX_PIECES = 16


@dataclass(frozen=True)
class Piece:
    """A bundle of a wardrobe; `problem` says why a file cannot be used, and then there is no card."""

    name: str
    path: Path
    card: BundleCard | None
    problem: str = ""


def pieces(folder: Path) -> list[Piece]:
    """All bundles of a folder by name; only headers are read. Raises MissingInput: no such folder."""
    if not folder.is_dir():
        raise MissingInput(
            "There is no such wardrobe.", str(folder), "Make one: gw wardrobe add DIR FILE.gwg."
        )
    found = []
    for path in sorted(folder.glob("*.gwg")):
        try:
            found.append(Piece(path.stem, path, read_card(path)))
        except GwError as error:
            found.append(Piece(path.stem, path, None, error.what))
    return found


def add_piece(folder: Path, source: Path, name: str = "") -> Piece:
    """Check a bundle completely and put it into the wardrobe, with its picture.

    Raises:
        UsageProblem: a name that is none, or taken by another bundle. BadData: the bundle is damaged.
    """
    from stages.shared.outfit.layer import check_bundle_model  # needs torch, which names alone do not

    name = name or source.stem
    if not _NAME.fullmatch(name):
        raise UsageProblem(
            f"{name!r} cannot be the name of a piece.", "option --name", "Use letters, digits, _ . and -."
        )
    data = read_bundle_bytes(source)
    bundle = decode_bundle(data, str(source))
    check_bundle_model(bundle, str(source))
    path = folder / f"{name}.gwg"
    with _writing(folder):
        if path.exists() and _digest(path) != bundle.digest:
            raise UsageProblem(
                f"The wardrobe has another {name}.",
                str(path),
                "Give it another --name, or remove that first.",
            )
        make_folders(folder / "previews")
        # The preview first: a piece that is there has its picture, whenever a kill comes.
        write_whole(folder / "previews" / f"{name}.png", encode_png(bundle.arrays["preview"]))
        write_whole(path, data)
    return Piece(name, path, read_card(path))


def _writing(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Be the only writer of a wardrobe; what killed processes left in it is removed first."""

    def clear() -> None:
        for part in (folder, folder / "previews"):
            sweep_files(part)

    return holding(folder, clear)


def _digest(path: Path) -> str:
    """Digest of a bundle that stands in the wardrobe; "" for one that cannot be used."""
    try:
        return read_card(path).digest
    except BadData:
        return ""


def remove_piece(folder: Path, name: str) -> Path:
    """Take a piece out of the wardrobe; returns the path it had. Raises MissingInput."""
    path = _named(folder, name).path
    with _writing(folder):
        path.unlink(missing_ok=True)
        (folder / "previews" / f"{path.stem}.png").unlink(missing_ok=True)
    return path


def chosen_pieces(folder: Path, names: Sequence[str]) -> list[Path]:
    """Bundles of a wardrobe by name, or by the first eight or more letters of their digest."""
    return [_named(folder, name).path for name in names]


def sensible_outfits(catalogue: Sequence[Piece]) -> Iterator[tuple[Piece, ...]]:
    """Every body with every set of garments that fit it and do not take the same slot.

    Yields bodies in order, each first alone, then with one garment, then with two, and so on. Sets that
    conflict are never enumerated: the work is that of the outfits that come out.
    """
    bodies = [piece for piece in catalogue if piece.card and piece.card.manifest["kind"] == "body"]
    garments = [piece for piece in catalogue if piece.card and piece.card.manifest["kind"] == "garment"]
    for body in bodies:
        wearable = [piece for piece in garments if fit(_card(piece), _card(body)) != "no"]
        # (garments, index of the first that may join, slots that are taken) of all sets of one size
        sets: list[tuple[tuple[Piece, ...], int, frozenset[str]]] = [((), 0, frozenset())]
        while sets:
            larger = []
            for worn, start, taken in sets:
                yield (body, *worn)
                for index in range(start, len(wearable)):
                    slots = frozenset(_card(wearable[index]).manifest["slots"])
                    if not slots & taken:
                        larger.append(((*worn, wearable[index]), index + 1, taken | slots))
            sets = larger


def count_outfits(catalogue: Sequence[Piece]) -> int:
    """Number of `sensible_outfits`, without making them: garments are counted by the slots that they take."""
    garments = [piece for piece in catalogue if piece.card and piece.card.manifest["kind"] == "garment"]
    total = 0
    for body in catalogue:
        if body.card is None or body.card.manifest["kind"] != "body":
            continue
        ways = {frozenset[str](): 1}  # slots that are taken -> number of sets that take them
        for garment in garments:
            if fit(_card(garment), body.card) == "no":
                continue
            slots = frozenset(_card(garment).manifest["slots"])
            for taken, number in list(ways.items()):
                if not slots & taken:
                    ways[taken | slots] = ways.get(taken | slots, 0) + number
        total += sum(ways.values())
    return total


def _card(piece: Piece) -> BundleCard:
    assert piece.card is not None
    return piece.card


def save_outfit(
    path: Path, bundles: Sequence[Path], betas: Sequence[float] | None = None, drive: str = "auto"
) -> None:
    """Write an outfit file that names these bundles by digest; `drive` as `--drive` takes it."""
    named = [{"name": bundle.stem, "digest": read_card(bundle).digest} for bundle in bundles]
    shape = None if betas is None else [float(value) for value in betas]
    content = {"format": OUTFIT_FORMAT, "version": 1, "pieces": named, "betas": shape, "drive": drive}
    write_whole(path, readable_json(content))


def open_outfit(path: Path, folder: Path | None = None) -> tuple[list[Path], str, str]:
    """The bundles an outfit file names, found by digest in a wardrobe (its own folder); its betas and drive.

    Raises:
        MissingInput: no such file, or a piece is not in the wardrobe. BadData: it is no outfit.
    """
    content = _read_outfit(path)
    folder = folder or path.parent
    by_digest = {piece.card.digest: piece for piece in pieces(folder) if piece.card is not None}
    found = []
    for entry in content["pieces"]:
        piece = by_digest.get(entry["digest"])
        if piece is None:
            same = folder / f"{entry['name'][:80]}.gwg"
            other = " (a file of that name holds something else)" if same.is_file() else ""
            raise MissingInput(
                f"The wardrobe lacks {entry['name'][:80]!r} with digest {entry['digest'][:12]}…{other}.",
                str(folder),
                "Add it: gw wardrobe add DIR FILE.gwg, or name another wardrobe with --wardrobe.",
            )
        found.append(piece.path)
    betas = content.get("betas")
    shape = "" if betas is None else ",".join(f"{value:.9g}" for value in betas)
    return found, shape, content.get("drive", "auto")


def _read_outfit(path: Path) -> dict[str, Any]:
    def wrong(what: str) -> BadData:
        return BadData(
            f"It is no outfit file: {what}.", str(path), "Write one with gw tryon … --save-outfit."
        )

    content = read_json(path, "an outfit", _MAX_OUTFIT_BYTES)
    if not isinstance(content, dict) or content.get("format") != OUTFIT_FORMAT:
        raise wrong(f"its format is not {OUTFIT_FORMAT}")
    if content.get("version") != 1:
        raise wrong("this program reads version 1")
    entries = content.get("pieces")
    if not isinstance(entries, list) or not 1 <= len(entries) <= _MAX_PIECES:
        raise wrong(f"it names no pieces, or more than {_MAX_PIECES}")
    for entry in entries:
        texts = isinstance(entry, dict) and all(isinstance(entry.get(k), str) for k in ("name", "digest"))
        if not texts or not re.fullmatch(r"[0-9a-f]{64}", entry["digest"]):
            raise wrong("a piece has no name or no digest")
    betas = content.get("betas")
    numbers = isinstance(betas, list) and all(type(value) in (int, float) for value in betas)
    if betas is not None and (not numbers or not 1 <= len(betas) <= 10):
        raise wrong("betas are not up to ten numbers")
    drive = content.get("drive", "auto")
    if not isinstance(drive, str) or len(drive) > _LONGEST_DRIVE:
        raise wrong("drive is no short text, such as auto or lower=simulated,upper=bones")
    return content


def _named(folder: Path, name: str) -> Piece:
    found = pieces(folder)
    for piece in found:
        if name in (piece.name, piece.path.name):
            return piece
    matching = [
        piece for piece in found if len(name) >= 8 and piece.card and piece.card.digest.startswith(name)
    ]
    if len(matching) == 1:
        return matching[0]
    raise MissingInput(
        f"The wardrobe has no {name!r}.",
        str(folder),
        "It has: " + (", ".join(piece.name for piece in found) or "nothing") + ".",
    )
