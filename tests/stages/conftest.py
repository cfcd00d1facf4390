"""A finished tiny subject that several stages' tests read."""

from __future__ import annotations

from pathlib import Path

import pytest

from stages.export_garment import stage as export
from stages.export_garment.config import ExportGarmentConfig
from tests.shared.outfit.wardrobe import make_subject, motion


@pytest.fixture(scope="session")
def dressed_subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A subject with body, lower and upper, trained; its capture stands beside it. Not to be changed."""
    return make_subject(tmp_path_factory.mktemp("dressed"))


@pytest.fixture(scope="session")
def wardrobe(dressed_subject: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with body.gwg, lower.gwg, upper.gwg of that subject, and motion.npz."""
    folder = tmp_path_factory.mktemp("wardrobe")
    for layer in ("body", "lower", "upper"):
        config = ExportGarmentConfig(layer=layer, preview_size=32)
        export.run(dressed_subject, folder / f"{layer}.gwg", config)
    (folder / "motion.npz").write_bytes(motion().to_npz_bytes())
    return folder
