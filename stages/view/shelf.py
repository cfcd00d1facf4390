"""What can be put on: bundles by name, or one trained subject; and the outfits made of them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.bundle import Bundle, read_bundle
from stages.shared.body import Poses
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.penetration import TRYON_MARGINS, PenetrationConfig
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.view.config import ViewConfig

_KEPT_OUTFITS = 6


@dataclass(frozen=True, eq=False)
class Piece:
    """A bundle on the shelf. name: what the page calls it; kind, layer, slots: as in its manifest."""

    name: str
    bundle: Bundle

    def described(self) -> dict[str, Any]:
        """For the page."""
        slots = self.bundle.manifest["slots"]
        return {"name": self.name, "layer": self.bundle.layer, "kind": self.bundle.kind, "slots": slots}


class Shelf:
    """Bundles to choose from, or the layers of one subject.

    Attributes:
        pieces: by name. worn: names that are worn at first. own_poses: of a subject.
    """

    def __init__(self, config: ViewConfig) -> None:
        self.pieces: dict[str, Piece] = {}
        self.worn: tuple[str, ...] = ()
        self.own_poses: Poses | None = None
        self._swap = config.swap
        self._subject: Outfit | None = None
        self._outfits: OrderedDict[tuple[str, ...], Outfit] = OrderedDict()

    def outfit(self, names: Sequence[str], betas: NDArray[np.float32] | None) -> Outfit:
        """What the named pieces are together, on a body of shape `betas` (10,), or its own.

        Raises UsageProblem: an unknown piece, no body, two pieces for one slot. BadData: they do not fit.
        """
        if self._subject is not None:
            made = self._subject
        else:
            key = tuple(sorted(names))
            if key not in self._outfits:
                named = [(name, self._piece(name).bundle) for name in key]
                self._outfits[key] = outfit_of_bundles(named, None, self._swap)
            self._outfits.move_to_end(key)
            while len(self._outfits) > _KEPT_OUTFITS:
                self._outfits.popitem(last=False)
            made = self._outfits[key]
        return made if betas is None else replace(made, betas=betas)

    @property
    def margins(self) -> PenetrationConfig:
        """Of the penetration pass, as `gw render` takes them."""
        return TRYON_MARGINS if self._subject is None else PenetrationConfig()

    def described(self) -> list[dict[str, Any]]:
        """Every piece, for the page; none for a subject, which is worn as it is."""
        return [piece.described() for piece in self.pieces.values()]

    def _piece(self, name: str) -> Piece:
        if name not in self.pieces:
            raise UsageProblem(
                f"There is no {name!r} here.", "wear", "Choose of: " + ", ".join(self.pieces) + "."
            )
        return self.pieces[name]

    def add(self, path: Path) -> str:
        """Put a bundle on the shelf; its name is that of the file, made unique."""
        name, count = path.stem, 1
        while name in self.pieces:
            count += 1
            name = f"{path.stem}-{count}"
        self.pieces[name] = Piece(name, read_bundle(path))
        return name

    def take_subject(self, folder: Path, distilled: bool) -> None:
        """Show a trained subject in its own clothes."""
        subject = TrainedSubject.open(folder, distilled)
        self._subject, self.own_poses = subject.outfit(), subject.poses()


def open_shelf(sources: Sequence[Path], wardrobe: Path | None, config: ViewConfig) -> tuple[Shelf, list[str]]:
    """The shelf with all bundles named, and what was left out of a folder and why.

    Arguments:
        sources: bundles that are worn at first; or one subject folder.
        wardrobe: a folder of further bundles to choose from; damaged ones are left out.

    Raises:
        UsageProblem: a subject among bundles, a folder without bundles. MissingInput, BadData: a source.
    """
    shelf = Shelf(config)
    left_out: list[str] = []
    folders = [path for path in sources if path.is_dir()]
    if folders and (len(sources) > 1 or wardrobe is not None):
        raise UsageProblem(
            "A subject is shown as it is; bundles cannot be added to it.",
            str(folders[0]),
            "Give one subject, or bundles and --wardrobe DIR (gw export-garment).",
        )
    if folders:
        shelf.take_subject(folders[0], config.distilled)
        return shelf, left_out
    shelf.worn = tuple(shelf.add(path) for path in sources)
    if wardrobe is not None:
        if not wardrobe.is_dir():
            raise MissingInput("There is no such folder.", str(wardrobe), "Check --wardrobe.")
        known = {piece.bundle.digest for piece in shelf.pieces.values()}
        for path in sorted(wardrobe.glob("*.gwg")):
            try:
                name = shelf.add(path)
            except (BadData, MissingInput) as error:
                left_out.append(f"{path}: {error.what}")
                continue
            if shelf.pieces[name].bundle.digest in known:
                del shelf.pieces[name]
    if not shelf.worn:
        bodies = [name for name, piece in shelf.pieces.items() if piece.bundle.kind == "body"]
        shelf.worn = tuple(bodies[:1])
    if not any(piece.bundle.kind == "body" for piece in shelf.pieces.values()):
        raise UsageProblem(
            "None of the bundles is a body.", "bundles", "Add one: gw export-garment SUBJECT --layer body."
        )
    return shelf, left_out
