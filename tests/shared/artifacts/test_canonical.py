"""Keys change with what determines a result, and with nothing else."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.shared.artifacts.canonical import artifact_key, canonical_json, seal, strict_json, to_json, unseal
from stages.shared.errors import BadData


@dataclass(frozen=True)
class Nested:
    name: str = "a"
    weight: float = 0.1


@dataclass(frozen=True)
class Sample:
    count: int = 3
    nested: Nested = Nested()
    sizes: tuple[int, ...] = (1, 2)
    device: str = field(default="cpu", metadata={"affects_result": False})


@dataclass(frozen=True)
class Later(Sample):
    """The same sample after an option was added."""

    added: tuple[str, ...] = field(default=(), metadata={"omit_default": True})


BASE: dict[str, Any] = {
    "stage": "s",
    "schema": "1.0",
    "code_version": 1,
    "config": Sample(),
    "inputs": {"a": "1" * 64, "b": "2" * 64},
}


@pytest.mark.parametrize(
    "changed",
    [
        {"stage": "t"},
        {"schema": "1.1"},
        {"code_version": 2},
        {"config": Sample(count=4)},
        {"config": Sample(nested=Nested(weight=0.2))},
        {"config": Sample(sizes=(2, 1))},
        {"inputs": {"a": "1" * 64, "b": "3" * 64}},
        {"inputs": {"a": "1" * 64}},
        {"inputs": {"a": "1" * 64, "c": "2" * 64}},
    ],
)
def test_the_key_changes_with_what_determines_the_result(changed: dict[str, Any]) -> None:
    assert artifact_key(**{**BASE, **changed}) != artifact_key(**BASE)


def test_an_option_added_later_changes_the_key_only_where_it_is_set() -> None:
    key = artifact_key(**BASE)
    assert artifact_key(**{**BASE, "config": Later()}) == key
    assert artifact_key(**{**BASE, "config": Later(added=("body",))}) != key


@pytest.mark.parametrize(
    "same",
    [
        {"inputs": {"b": "2" * 64, "a": "1" * 64}},
        {"config": Sample(device="cuda")},
        {"config": {"sizes": [1, 2], "nested": {"weight": 0.1, "name": "a"}, "count": 3}},
        {"config": {"count": np.int64(3), "nested": Nested(), "sizes": np.array([1, 2])}},
    ],
)
def test_the_key_does_not_change_with_order_or_device(same: dict[str, Any]) -> None:
    assert artifact_key(**{**BASE, **same}) == artifact_key(**BASE)


def test_the_key_of_this_version_of_the_store_is_fixed() -> None:
    """Every finished artifact of every user is found by it: a change here makes all of them stale."""
    text = (
        '{"code_version":1,"config":{"count":3,"nested":{"name":"a","weight":0.1},"sizes":[1,2]},'
        f'"inputs":{{"a":"{"1" * 64}","b":"{"2" * 64}"}},"schema":"1.0","stage":"s"}}'
    )
    assert artifact_key(**BASE) == hashlib.sha256(text.encode()).hexdigest()[:32]


def test_text_is_the_same_for_the_same_value() -> None:
    assert canonical_json({"b": 1, "a": (1.5, "ü")}) == '{"a":[1.5,"ü"],"b":1}'.encode()


@pytest.mark.parametrize("value", [float("nan"), np.float32("inf"), [1.0, -float("inf")]])
def test_numbers_that_are_not_finite_have_no_text(value: Any) -> None:
    with pytest.raises(ValueError, match="not a finite number"):
        to_json(value)


@pytest.mark.parametrize("value", [Path("/somewhere"), object(), b"bytes"])
def test_paths_and_objects_have_no_text(value: Any) -> None:
    with pytest.raises(TypeError):
        to_json({"inner": value})


@pytest.mark.parametrize("text", [b"NaN", b'{"a":1,"a":2}', b"[Infinity]", b"{", b"\xff"])
def test_json_that_is_not_strict_is_refused(text: bytes) -> None:
    with pytest.raises(ValueError):
        strict_json(text)


def test_every_flipped_bit_of_a_sealed_record_is_found() -> None:
    data = seal({"key": "abc", "numbers": [1, 2.5], "text": "ü"})
    assert unseal(data, Path("x")) == {"key": "abc", "numbers": [1, 2.5], "text": "ü"}
    for position in range(len(data) * 8):
        flipped = bytearray(data)
        flipped[position // 8] ^= 1 << position % 8
        with pytest.raises(BadData):
            unseal(bytes(flipped), Path("x"))
