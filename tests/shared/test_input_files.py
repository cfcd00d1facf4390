"""Text, JSON and size bounds of files that other programs wrote."""

from __future__ import annotations

import codecs
import json
import os
from pathlib import Path

import pytest

from stages.shared.errors import BadData, MissingInput
from stages.shared.input_files import (
    decode_text,
    read_input,
    read_json,
    read_json_object,
    read_text,
    strict_json,
)

_TEXT = '{"name": "Füße", "list": [1, 2.5]}\r\n'
_MARKED = {
    "utf-8": codecs.BOM_UTF8 + _TEXT.encode(),
    "utf-16-le": codecs.BOM_UTF16_LE + _TEXT.encode("utf-16-le"),
    "utf-16-be": codecs.BOM_UTF16_BE + _TEXT.encode("utf-16-be"),
    "utf-32-le": codecs.BOM_UTF32_LE + _TEXT.encode("utf-32-le"),
    "utf-16-le without a mark": _TEXT.encode("utf-16-le"),
    "utf-16-be without a mark": _TEXT.encode("utf-16-be"),
    "plain": _TEXT.encode(),
}


@pytest.mark.parametrize("kind", _MARKED)
def test_text_is_the_same_with_every_byte_order_mark(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(_MARKED[kind])
    assert decode_text(_MARKED[kind]) == _TEXT
    assert read_text(path, "a text") == _TEXT
    assert read_json_object(path, "a test") == {"name": "Füße", "list": [1, 2.5]}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"a": 1, "a": 2}', "'a' stands twice"),
        ('{"b": [{"c": 1, "c": 1}]}', "'c' stands twice"),
        ('{"a": NaN}', "NaN"),
        ('{"a": -Infinity}', "Infinity"),
        ('{"a": 1e400}', "1e400"),
        ('{"a": -2.5e999}', "e999"),
        ('{"a": ' + "9" * 5000 + "}", "beyond what 64 bits"),
        ('{"a": 18446744073709551616}', "beyond what 64 bits"),
        ('{"a": -36893488147419103232}', "beyond what 64 bits"),
        ("[" * 200_000, "nested too deeply"),
        ('{"a":' * 100_000, "nested too deeply"),
        ("{'a': 1}", "Expecting property name"),
    ],
)
def test_json_outside_the_standard_is_refused_with_its_reason(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=reason):
        strict_json(text.encode())
    with pytest.raises(BadData) as refusal:
        read_json(path, "a camera path")
    assert reason in refusal.value.what and "a camera path" in refusal.value.what
    assert refusal.value.where == str(path)


def test_numbers_of_64_bits_are_read() -> None:
    numbers = {"a": 2**63, "b": -(2**63), "c": 1e308, "d": -5e-324, "e": 0}
    assert strict_json(json.dumps(numbers).encode()) == numbers


def test_other_values_than_an_object_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for text in ("[1]", "3", '"text"', "null"):
        path.write_text(text)
        with pytest.raises(BadData, match="does not hold a JSON object"):
            read_json_object(path, "a test")


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path(os.devnull), tmp_path):
        with pytest.raises(BadData, match="not a test"):
            read_input(path, "a test")
    for path in (tmp_path / "absent", tmp_path / "absent" / "below", Path("nul\0byte")):
        with pytest.raises(MissingInput, match="a test"):
            read_input(path, "a test")


def test_a_file_larger_than_the_limit_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    with path.open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(BadData, match="at most 16777216"):
        read_json(path, "a test")


def test_bytes_that_are_not_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"abc\xff\xfe\xfa")
    with pytest.raises(BadData, match="byte 3"):
        read_text(path, "a text")
    assert read_text(path, "a text", errors="replace").startswith("abc")
