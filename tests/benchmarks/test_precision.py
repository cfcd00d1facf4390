"""What 16 bits cost, measured on an outfit of tubes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stages.export_garment import stage as export
from stages.export_garment.config import ExportGarmentConfig
from stages.shared.errors import UsageProblem
from tests.benchmarks import precision
from tests.benchmarks.precision import BenchPrecisionConfig

SMALL = BenchPrecisionConfig(frames=2, width=48, height=64)


def test_sixteen_bits_save_half_and_cost_nothing_visible(
    dressed_subject: Path, wardrobe: Path, tmp_path: Path
) -> None:
    bundles = [tmp_path / f"{layer}.gwg" for layer in ("body", "upper")]
    for path in bundles:
        export.run(
            dressed_subject, path, ExportGarmentConfig(layer=path.stem, precision="float32", preview_size=16)
        )
    out = tmp_path / "precision.json"
    kinds = precision.run(bundles, wardrobe / "motion.npz", out, SMALL).summary["kinds"]
    assert json.loads(out.read_text())["kinds"] == kinds
    assert {"maps/skin_weights", "model", "all"} <= kinds.keys() and "maps/positions" not in kinds
    saved = {name: row["bytes_32"] - row["bytes_16"] for name, row in kinds.items()}
    assert saved["all"] == sum(size for name, size in saved.items() if name != "all") > 0
    assert all(row["psnr"] is None or row["psnr"] > 45 for row in kinds.values())
    assert kinds["all"]["largest_difference"] <= 12
    with pytest.raises(UsageProblem, match="16 bits already"):
        precision.run([wardrobe / "body.gwg"], wardrobe / "motion.npz", out, SMALL)
