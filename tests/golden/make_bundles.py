"""Make the golden bundles of the current schema: `python -m tests.golden.make_bundles`.

They are kept for good. Run this only when the schema's version rises, under new names; a golden file that is
overwritten no longer shows that older files are still read.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.artifacts.bundle import SCHEMA, Bundle, write_bundle
from stages.shared.artifacts.bundle_precision import halved
from stages.shared.body import embedded_body
from stages.shared.outfit.retarget import canonical_joints
from tests.shared.outfit.wardrobe import bundle, simulated, worn

FOLDER = Path(__file__).parent
VERTICES = 60
NEW = ("garment-cloth",)  # in this version of the schema; the others were made by earlier ones
NOTE = "golden bundle: tubes of noise"


def golden() -> dict[str, Bundle]:
    """A garment of two slots with 32 bits and with 16, one with a simulation mesh, and a body."""
    short: dict[str, Any] = {"low": 0.0, "high": 0.04}
    upper = bundle(worn("upper", source="golden", **short))
    upper = replace(upper, manifest={**upper.manifest, "slots": ["upper", "outer"]})
    body = bundle(worn("body", source="golden", **short))
    kept = {name: array for name, array in body.arrays.items() if not name.startswith("body/")}
    body = replace(body, arrays={**kept, **_small_body(), **_skin(len(kept["maps/texels"]))})
    made = {"garment-f32": upper, "garment-f16": halved_bundle(upper)}
    made |= {"body": halved_bundle(body)}
    cloth = simulated("lower", source="golden", low=-0.12, high=-0.02)
    made |= {"garment-cloth": halved_bundle(bundle(cloth))}
    joints = canonical_joints(embedded_body())
    noted = {name: {**one.manifest, "note": NOTE} for name, one in made.items()}
    return {name: Bundle(noted[name], {**one.arrays, "joints": joints}) for name, one in made.items()}


def halved_bundle(whole: Bundle) -> Bundle:
    """With 16 bits where that is allowed."""
    return replace(whole, arrays=halved(whole.arrays))


def _small_body() -> dict[str, np.ndarray]:
    """A body model of few vertices: every joint is one of them."""
    body = embedded_body()
    chosen = np.linspace(0, len(body.template_vertices) - 1, VERTICES).astype(int)
    regressor = np.zeros((55, VERTICES), np.float32)
    regressor[np.arange(55), np.arange(55)] = 1
    faces = np.stack([np.arange(VERTICES - 2), np.arange(1, VERTICES - 1), np.arange(2, VERTICES)], axis=1)
    return {
        "body/template_vertices": body.template_vertices[chosen],
        "body/faces": faces.astype(np.int32),
        "body/shape_directions": body.shape_directions[chosen],
        "body/joint_regressor": regressor,
        "body/skin_weights": body.skin_weights[chosen],
    }


def _skin(count: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(3)
    return {
        "skin/covered": random.uniform(0, 1, count).astype(np.float32),
        "skin/offsets": random.normal(0, 0.003, (count, 3)).astype(np.float32),
        "skin/colors": random.uniform(0, 1, (count, 3)).astype(np.float32),
    }


def main() -> None:
    """Write the files and `bundles.json`, their digests."""
    version = f"{SCHEMA['major']}.{SCHEMA['minor']}"
    digests = json.loads((FOLDER / "bundles.json").read_text())
    for name, made in golden().items():
        if name not in NEW:
            continue
        path = FOLDER / f"{name}-{version}.gwg"
        digests[path.name] = {"digest": write_bundle(path, made), "bytes": path.stat().st_size}
    (FOLDER / "bundles.json").write_text(json.dumps(digests, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
