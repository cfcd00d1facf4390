"""The `model` object of a bundle's manifest: its fields, their types and their bounds.

The bounds are generous: they are there so that a number from a file can never decide how much memory or time
its reader takes. Whether the tensors have the shapes that these numbers ask for is checked before a model is
built (`stages/shared/avatar/decoders/base.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from stages.shared.errors import BadData


@dataclass(frozen=True)
class Whole:
    """A whole number from `low` to `high`."""

    low: int
    high: int

    def accepts(self, value: Any) -> bool:
        return type(value) is int and self.low <= value <= self.high

    def __str__(self) -> str:
        return f"a whole number from {self.low} to {self.high}"


@dataclass(frozen=True)
class Real:
    """A number from `low` to `high`."""

    low: float
    high: float

    def accepts(self, value: Any) -> bool:
        return type(value) in (int, float) and self.low <= value <= self.high

    def __str__(self) -> str:
        return f"a number from {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Choice:
    """One of some words, or true or false."""

    values: tuple[str | bool, ...]

    def accepts(self, value: Any) -> bool:
        return any(type(value) is type(known) and value == known for known in self.values)

    def __str__(self) -> str:
        return "one of " + ", ".join(str(value).lower() for value in self.values)


@dataclass(frozen=True)
class Ranks:
    """Three whole numbers from 1 to 256: bases for offsets, colours and form."""

    def accepts(self, value: Any) -> bool:
        return (
            isinstance(value, list | tuple)
            and len(value) == 3
            and all(Whole(1, 256).accepts(one) for one in value)
        )

    def __str__(self) -> str:
        return "three whole numbers from 1 to 256"


@dataclass(frozen=True)
class Name:
    """A short text; the code that looks it up reports an unknown one."""

    def accepts(self, value: Any) -> bool:
        return isinstance(value, str) and 0 < len(value) <= 40

    def __str__(self) -> str:
        return "a name"


_FLAG = Choice((False, True))
FIELDS: dict[str, Whole | Real | Choice | Ranks | Name] = {
    "decoder": Name(),
    "ranks": Ranks(),
    "heads": Choice(("joint", "separate")),
    "networks": Choice(("all", "garments", "none")),
    "width": Real(1e-3, 4),
    "depth": Whole(2, 8),
    "style": Whole(1, 2048),
    "factor": Whole(1, 64),
    "input_views": Choice(("front", "both")),
    "normalise": _FLAG,
    "anchors": Whole(0, 100_000),
    "anchor_cell": Whole(1, 256),
    "anchor_widths": Choice(("shared", "own")),
    "history": Whole(0, 8),
    "pose_prior": Whole(0, 4096),
    "pose_sigma": Real(0, 1000),
    "base": _FLAG,
    "color": Choice(("sigmoid", "linear")),
    "view_conditioning": _FLAG,
    "offset_scale": Real(1e-6, 10),
    "max_scale": Real(0, 10),
}
_SIZE = Whole(0, 1 << 16)


def check_model(model: Mapping[str, Any], where: str) -> None:
    """Raise BadData for a field that is unknown, of another type, or out of its bounds.

    Arguments:
        model: configuration of a layer's decoder, as `Decoder.config` gives it: `FIELDS`, `layer`, `texels`,
            and objects of sizes that belong to one decoder. Fields may be missing; they have defaults.
        where: the file, for the message.
    """
    for name, value in model.items():
        if name in ("layer", "texels"):
            continue
        if isinstance(value, dict) and name not in FIELDS:
            _check_sizes(name, value, where)
        elif name not in FIELDS:
            raise _refused(f"its model has the unknown setting {str(name)[:40]!r}", where, str(name))
        elif not FIELDS[name].accepts(value):
            raise _refused(f"its model setting {name!r} is {_short(value)}, not {FIELDS[name]}", where, name)
    if not Name().accepts(model.get("layer", "body")):
        raise _refused("its model names no layer", where, "layer")
    if not Whole(1, 1 << 24).accepts(model.get("texels")):
        raise _refused(f"its model has {_short(model.get('texels'))} texels", where, "texels")


def _check_sizes(group: str, sizes: dict[str, Any], where: str) -> None:
    for name, size in sizes.items():
        if not _SIZE.accepts(size):
            raise _refused(
                f"its model's size {name[:40]!r} is {_short(size)}, not {_SIZE}", where, f"{group}.{name}"
            )


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _refused(what: str, where: str, field: str) -> BadData:
    return BadData(
        f"The model cannot be used: {what}.",
        f"{where}, model.{field[:40]}",
        "Fetch a whole copy, or export it again from its subject; a newer bundle needs a newer gw.",
    )
