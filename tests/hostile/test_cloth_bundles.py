"""Simulation meshes from strangers: each broken value is refused, naming the tensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stages.shared.artifacts.bundle import Bundle, decode_bundle, encode_bundle
from stages.shared.errors import BadData
from tests.hostile.forge import forged_parts
from tests.shared.outfit.wardrobe import bundle, simulated

GOOD = bundle(simulated("lower"))


def _arrays(name: str, change: Callable[[np.ndarray], Any]) -> Bundle:
    array = GOOD.arrays[f"cloth/{name}"].copy()
    changed = change(array)
    return replace(GOOD, arrays={**GOOD.arrays, f"cloth/{name}": array if changed is None else changed})


def _entry(**change: Any) -> Bundle:
    return replace(GOOD, manifest={**GOOD.manifest, "cloth": {**GOOD.manifest["cloth"], **change}})


def _material(**change: Any) -> Bundle:
    return _entry(material={**GOOD.manifest["cloth"]["material"], **change})


def _without(name: str) -> Bundle:
    return replace(GOOD, arrays={key: array for key, array in GOOD.arrays.items() if key != name})


def _set(index: Any, value: float) -> Callable[[np.ndarray], None]:
    def change(array: np.ndarray) -> None:
        array[index] = value

    return change


BROKEN: dict[str, tuple[Callable[[], Bundle], str]] = {
    "missing": (lambda: _without("cloth/pinned"), "missing"),
    "face beyond": (lambda: _arrays("faces", _set((0, 0), 10**6)), "faces"),
    "negative face": (lambda: _arrays("faces", _set((0, 0), -1)), "faces"),
    "face twice": (lambda: _arrays("faces", lambda a: a[:, [0, 0, 1]].copy()), "twice"),
    "NaN": (lambda: _arrays("vertices", _set((3, 1), np.nan)), "vertices"),
    "infinite offset": (lambda: _arrays("texel_offsets", _set((0, 0), np.inf)), "texel_offsets"),
    "far vertex": (lambda: _arrays("vertices", _set((0, 0), 50.0)), "vertices"),
    "far rest": (lambda: _arrays("rest_vertices", _set((0, 0), 50.0)), "rest_vertices"),
    "no area": (lambda: _arrays("rest_vertices", lambda a: np.zeros_like(a)), "area"),
    "rest length 0": (lambda: _arrays("rest_lengths", _set(0, 0.0)), "rest_lengths"),
    "rest lengths of other edges": (lambda: _arrays("rest_lengths", lambda a: a[:-1].copy()), "edges"),
    "pin 2": (lambda: _arrays("pinned", _set(0, 2)), "pinned"),
    "texel on no face": (lambda: _arrays("texel_faces", _set(0, 10**6)), "texel_faces"),
    "weights": (lambda: _arrays("skin_weights", lambda a: a * 0.5), "sum to one"),
    "half precision": (lambda: _arrays("vertices", lambda a: a.astype(np.float16)), "F16"),
    "fewer texels": (lambda: _arrays("texel_weights", lambda a: a[:-1].copy()), "texel_weights"),
    "driver": (lambda: _entry(drive="magic"), "magic"),
    "extra": (lambda: _entry(other=1), "simulation"),
    "density": (lambda: _material(density=0.0), "density"),
    "steps": (lambda: _material(steps_per_second=1e9), "steps_per_second"),
    "text": (lambda: _material(drag="much"), "drag"),
    "no entry": (
        lambda: replace(GOOD, manifest={k: v for k, v in GOOD.manifest.items() if k != "cloth"}), "disagree"
    ),
}  # fmt: skip


def test_a_good_one_is_read_as_it_was_written() -> None:
    content = b"".join(encode_bundle(GOOD))
    again = decode_bundle(bytearray(content), "good")
    assert all(np.array_equal(array, again.arrays[name]) for name, array in GOOD.arrays.items())
    assert again.manifest["cloth"] == GOOD.manifest["cloth"]


@pytest.mark.parametrize("case", BROKEN)
def test_broken_ones_are_refused_by_reader_and_writer(case: str) -> None:
    make, word = BROKEN[case]
    broken = make()
    for attempt in (
        lambda: encode_bundle(broken),
        lambda: decode_bundle(bytearray(forged_parts(broken.arrays, broken.manifest)), "x.gwg"),
    ):
        with pytest.raises(BadData) as caught:
            attempt()
        assert word in f"{caught.value.what} {caught.value.where}"
