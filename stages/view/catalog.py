"""The bundles that the viewer can show by name, or one trained subject; and the outfits made of them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.bundle import Bundle, read_bundle
from stages.shared.artifacts.pictures import encode_png
from stages.shared.body import Poses
from stages.shared.errors import BadData, MissingInput, StorageFailure, UsageProblem
from stages.shared.outfit.layer import check_bundle_model
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.penetration import TRYON_MARGINS, PenetrationConfig
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.view.config import ViewConfig

_CACHED_OUTFITS = 6


@dataclass(frozen=True, eq=False)
class Item:
    """A bundle with the name that the page shows for it."""

    name: str
    bundle: Bundle

    def described(self) -> dict[str, Any]:
        """For the page."""
        slots = self.bundle.manifest["slots"]
        return {"name": self.name, "layer": self.bundle.layer, "kind": self.bundle.kind, "slots": slots}


class BundleCatalog:
    """Bundles to choose from, or the layers of one subject.

    Attributes:
        items: by name. worn: names that are worn at first. subject_poses: of a subject.
    """

    def __init__(self, config: ViewConfig) -> None:
        self.items: dict[str, Item] = {}
        self.worn: tuple[str, ...] = ()
        self.subject_poses: Poses | None = None
        self._swap, self._drive = config.swap, config.drive
        self._subject: Outfit | None = None
        self._outfits: OrderedDict[tuple[str, ...], Outfit] = OrderedDict()
        self._driven: OrderedDict[tuple[tuple[str, ...], bytes, bool], Outfit] = OrderedDict()

    def outfit(
        self, names: Sequence[str], betas: NDArray[np.float32] | None, trained_poses: bool = False
    ) -> Outfit:
        """What the named items are together, on a body of shape `betas` (10,), or its own.

        Recent outfits are the same objects with the same simulation, so frames that are simulated already are
        shown at once.

        Arguments:
            trained_poses: the motion is the one that the garments were learned in.

        Raises UsageProblem: an unknown item, no body, two items for one slot. BadData: they do not fit.
        """
        if self._subject is not None:
            made = self._subject
        else:
            key = tuple(sorted(names))
            if key not in self._outfits:
                named = [(name, self._item(name).bundle) for name in key]
                self._outfits[key] = outfit_of_bundles(named, None, self._swap)
            self._outfits.move_to_end(key)
            while len(self._outfits) > _CACHED_OUTFITS:
                self._outfits.popitem(last=False)
            made = self._outfits[key]
        shaped = made if betas is None else replace(made, betas=betas)
        known = (
            shaped.names if self._subject else tuple(sorted(names)),
            shaped.betas.tobytes(),
            trained_poses,
        )
        if known not in self._driven:
            self._driven[known] = shaped.driven(self._drive, trained_poses)
        self._driven.move_to_end(known)
        while len(self._driven) > _CACHED_OUTFITS:
            self._driven.popitem(last=False)
        return self._driven[known]

    @property
    def margins(self) -> PenetrationConfig:
        """Of the penetration pass, as `gw render` takes them."""
        return TRYON_MARGINS if self._subject is None else PenetrationConfig()

    def described(self) -> list[dict[str, Any]]:
        """Every item, for the page; none for a subject, which is worn as it is."""
        return [item.described() for item in self.items.values()]

    def preview(self, name: str) -> bytes:
        """The picture in a bundle as PNG. Raises UsageProblem for an unknown name."""
        return encode_png(self._item(name).bundle.arrays["preview"])

    def _item(self, name: str) -> Item:
        if name not in self.items:
            raise UsageProblem(
                f"There is no {name!r} here.", "wear", "Choose of: " + ", ".join(self.items) + "."
            )
        return self.items[name]

    def add(self, path: Path) -> str:
        """Add a bundle; its name is that of the file, made unique. Raises BadData, MissingInput."""
        return self.add_bundle(path.stem, read_bundle(path), str(path))

    def add_bundle(self, stem: str, bundle: Bundle, where: str) -> str:
        """Add a bundle that was read, after its model was checked; the same content again is not added.

        Returns its name. Raises BadData.
        """
        for item in self.items.values():
            if item.bundle.digest == bundle.digest:
                return item.name
        if self._subject is not None:
            raise UsageProblem(
                "A subject is shown as it is; bundles cannot be added to it.",
                where,
                "Start gw view with bundles or --wardrobe DIR.",
            )
        check_bundle_model(bundle, where)
        name, count = stem, 1
        while name in self.items:
            count += 1
            name = f"{stem}-{count}"
        self.items[name] = Item(name, bundle)
        return name

    def take_subject(self, folder: Path, distilled: bool) -> None:
        """Show a trained subject in its own clothes."""
        subject = TrainedSubject.open(folder, distilled)
        self._subject, self.subject_poses = subject.outfit(), subject.poses()


def open_catalog(
    sources: Sequence[Path], wardrobe: Path | None, config: ViewConfig
) -> tuple[BundleCatalog, list[str]]:
    """The catalogue of all bundles, and what was left out of a folder and why.

    Arguments:
        sources: bundles that are worn at first; or one subject folder.
        wardrobe: a folder of further bundles to choose from; damaged ones are left out.

    Raises:
        UsageProblem: a subject among bundles, a folder without bundles. MissingInput, BadData: a source.
    """
    catalog = BundleCatalog(config)
    left_out: list[str] = []
    folders = [path for path in sources if path.is_dir()]
    if folders and (len(sources) > 1 or wardrobe is not None):
        raise UsageProblem(
            "A subject is shown as it is; bundles cannot be added to it.",
            str(folders[0]),
            "Give one subject, or bundles and --wardrobe DIR (gw export-garment).",
        )
    if folders:
        catalog.take_subject(folders[0], config.distilled)
        return catalog, left_out
    catalog.worn = tuple(catalog.add(path) for path in sources)
    if wardrobe is not None:
        if not wardrobe.is_dir():
            raise MissingInput("There is no such folder.", str(wardrobe), "Check --wardrobe.")
        for path in sorted(wardrobe.glob("*.gwg")):
            try:
                catalog.add(path)
            except (BadData, MissingInput, StorageFailure) as error:
                left_out.append(f"{path}: {error.what}")
    if not catalog.worn:
        bodies = [name for name, item in catalog.items.items() if item.bundle.kind == "body"]
        catalog.worn = tuple(bodies[:1])
    if not any(item.bundle.kind == "body" for item in catalog.items.values()):
        raise UsageProblem(
            "None of the bundles is a body.", "bundles", "Add one: gw export-garment SUBJECT --layer body."
        )
    return catalog, left_out
