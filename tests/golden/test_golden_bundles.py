"""Bundles that an earlier version wrote are read as they were written, for good."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.shared.artifacts.bundle import SCHEMA, encode_bundle, read_bundle, read_card
from stages.shared.artifacts.bundle_precision import whole
from stages.shared.outfit.layer import layer_of_bundle
from stages.shared.outfit.outfit import outfit_of_bundles
from tests.shared.outfit.wardrobe import motion

FOLDER = Path(__file__).parent
KNOWN = json.loads((FOLDER / "bundles.json").read_text())
CLOTH = FOLDER / "garment-cloth-1.2.gwg"
CURRENT = f"{SCHEMA['major']}.{SCHEMA['minor']}"
BODY, UPPER, HALF = (FOLDER / f"{name}-1.1.gwg" for name in ("body", "garment-f32", "garment-f16"))


def test_they_are_all_there_and_small() -> None:
    assert {path.name for path in FOLDER.glob("*.gwg")} == set(KNOWN)
    assert sum(path.stat().st_size for path in FOLDER.glob("*.gwg")) < 420_000
    assert any(name.endswith(f"-{CURRENT}.gwg") for name in KNOWN), "make golden bundles of this schema"


@pytest.mark.parametrize("name", KNOWN)
def test_each_is_read_as_it_was_written(name: str) -> None:
    path = FOLDER / name
    found = read_bundle(path)
    assert found.digest == KNOWN[name]["digest"] == read_bundle(path).digest == read_card(path).digest
    assert path.stat().st_size == KNOWN[name]["bytes"]
    if name.endswith(f"-{CURRENT}.gwg"):
        assert b"".join(encode_bundle(found)) == path.read_bytes()


def test_half_precision_is_the_rounded_whole() -> None:
    full, half = read_bundle(UPPER).arrays, read_bundle(HALF).arrays
    assert half["maps/positions"].dtype == np.float32 and half["maps/skin_weights"].dtype == np.float16
    for name, array in whole(half).items():
        tolerance = 0 if half[name].dtype == full[name].dtype else 2e-3
        assert np.allclose(array, full[name], rtol=tolerance, atol=tolerance), name


def test_they_can_be_worn() -> None:
    for garment in (UPPER, HALF, CLOTH):
        outfit = outfit_of_bundles([(path.name, read_bundle(path)) for path in (BODY, garment)])
        composite = outfit.composite(motion(), 2)
        assert torch.isfinite(composite.means).all() and len(outfit.layers) == 2
    assert layer_of_bundle(read_bundle(BODY)).skin is not None
    simulated = layer_of_bundle(read_bundle(CLOTH))
    assert simulated.cloth is not None and simulated.drive == "simulated"
    assert layer_of_bundle(read_bundle(UPPER)).drive == "learned"
    assert layer_of_bundle(read_bundle(HALF)).slots == ("upper", "outer")
