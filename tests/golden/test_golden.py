"""Artifacts of every released store open for good; newer ones are refused with both numbers."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from stages.shared.artifacts import StageSpec, Workspace
from stages.shared.artifacts.canonical import seal, unseal
from stages.shared.artifacts.verify import verify
from stages.shared.errors import BadData

STORES = {"store_1": "6f1f066004af44d8c450606124cbc4e025ecda8f77d7130124f363b89b1924d7"}
GOLDEN = StageSpec("golden", "gw golden SUBJECT", ())


@pytest.mark.parametrize(("name", "digest"), STORES.items())
def test_it_opens_with_the_digest_it_had(name: str, digest: str) -> None:
    workspace = Workspace(Path(__file__).parent / name)
    artifact = workspace.require(GOLDEN)
    assert artifact.digest == digest
    np.testing.assert_array_equal(artifact.arrays("numbers")["points"][1], [0.375, 0.5, 0.625])
    assert artifact.json("notes") == {"count": 3, "text": "made by the first store"}
    assert verify(workspace).damaged == []


def test_a_newer_store_is_refused_with_both_numbers(tmp_path: Path) -> None:
    shutil.copytree(Path(__file__).parent / "store_1", tmp_path / "subject")
    (path,) = (tmp_path / "subject").glob("golden/*/manifest.json")
    manifest = unseal(path.read_bytes(), path)
    path.write_bytes(seal(manifest | {"store": 7}))
    with pytest.raises(BadData, match=r"version 7 .* reads 1"):
        Workspace(tmp_path / "subject").require(GOLDEN)


def test_a_newer_schema_is_refused_with_both_numbers() -> None:
    newer = StageSpec("golden", "gw golden SUBJECT", (), schema="2.0")
    with pytest.raises(BadData, match=r"schema 1\.0; this gw reads 2\.0"):
        Workspace(Path(__file__).parent / "store_1").require(newer)
