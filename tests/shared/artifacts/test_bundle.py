"""Bundles: the same content gives the same bytes, and what comes back is what went in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open

from stages.shared.artifacts.bundle import Bundle, encode_bundle, read_bundle, write_bundle
from stages.shared.artifacts.canonical import to_json
from stages.shared.errors import BadData, MissingInput
from tests.shared.outfit.wardrobe import bundle, worn


@pytest.fixture(scope="module")
def garment() -> Bundle:
    return bundle(worn("upper"))


def test_round_trip_is_exact_and_repeatable(tmp_path: Path, garment: Bundle) -> None:
    first, second = tmp_path / "a.gwg", tmp_path / "b.gwg"
    digest = write_bundle(first, garment)
    found = read_bundle(first)
    assert write_bundle(second, found) == digest == found.digest == read_bundle(second).digest
    assert first.read_bytes() == second.read_bytes()
    assert set(found.arrays) == set(garment.arrays)
    for name, array in garment.arrays.items():
        assert np.array_equal(found.arrays[name], array) and found.arrays[name].dtype == array.dtype
    for name, value in garment.manifest.items():
        assert found.manifest[name] == to_json(value)


def test_order_of_arrays_does_not_matter(garment: Bundle) -> None:
    turned = Bundle(dict(reversed(garment.manifest.items())), dict(reversed(garment.arrays.items())))
    assert b"".join(encode_bundle(turned)) == b"".join(encode_bundle(garment))


def test_digest_tells_any_change(tmp_path: Path, garment: Bundle) -> None:
    digests = {write_bundle(tmp_path / "a.gwg", garment)}
    colors = garment.arrays["maps/colors"].copy()
    colors[7, 1] = np.nextafter(colors[7, 1], np.float32(1))
    digests.add(
        write_bundle(tmp_path / "a.gwg", Bundle(garment.manifest, {**garment.arrays, "maps/colors": colors}))
    )
    digests.add(
        write_bundle(tmp_path / "a.gwg", Bundle({**garment.manifest, "note": "blue"}, garment.arrays))
    )
    assert len(digests) == 3


def test_other_programs_read_the_tensors(tmp_path: Path, garment: Bundle) -> None:
    write_bundle(tmp_path / "a.gwg", garment)
    with safe_open(tmp_path / "a.gwg", framework="numpy") as file:
        assert set(file.keys()) == set(garment.arrays)
        for name in file.keys():  # noqa: SIM118
            assert np.array_equal(file.get_tensor(name), garment.arrays[name])


def test_body_bundle_carries_its_model(tmp_path: Path) -> None:
    body = bundle(worn("body"))
    write_bundle(tmp_path / "body.gwg", body)
    found = read_bundle(tmp_path / "body.gwg")
    assert found.kind == "body" and found.layer == "body"
    assert set(found.group("body")) >= {"template_vertices", "joint_regressor", "shape_directions"}


def test_nothing_private_is_written(garment: Bundle) -> None:
    for text in ("/home/someone/capture", "~/capture", "C:\\Users\\me", "\\\\server\\share"):
        with pytest.raises(BadData, match="place on a disk"):
            encode_bundle(
                Bundle({**garment.manifest, "training": {"config": {"folder": text}}}, garment.arrays)
            )


def test_what_would_be_refused_is_not_written(tmp_path: Path, garment: Bundle) -> None:
    path = tmp_path / "a.gwg"
    arrays = {**garment.arrays, "maps/positions": garment.arrays["maps/positions"] * np.nan}
    with pytest.raises(BadData):
        write_bundle(path, Bundle(garment.manifest, arrays))
    assert not path.exists() and not list(tmp_path.iterdir())


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(MissingInput):
        read_bundle(tmp_path / "none.gwg")
    with pytest.raises(MissingInput):
        read_bundle(tmp_path)
