"""A small made-up body model with everything a file can hold, and as a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.shared.body import PARENTS

VERTICES = 130


def smplx_arrays(columns: int = 10) -> dict[str, np.ndarray]:
    """Arrays under the names of SMPL-X files; numbers are random, sums are right."""
    random = np.random.default_rng(3)
    regressor = random.random((55, VERTICES))
    weights = random.random((VERTICES, 55)) ** 8
    parents = np.array(PARENTS, dtype=np.int64)
    parents[0] = 2**32 - 1
    return {
        "v_template": random.normal(0, 0.5, (VERTICES, 3)),
        "f": random.integers(0, VERTICES, (40, 3)).astype(np.uint32),
        "shapedirs": random.normal(0, 0.02, (VERTICES, 3, columns)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(55)]),
        "posedirs": random.normal(0, 0.01, (VERTICES, 3, 486)),
        "hands_componentsl": random.normal(0, 0.3, (45, 45)),
        "hands_componentsr": random.normal(0, 0.3, (45, 45)),
        "hands_meanl": random.normal(0, 0.3, 45),
        "hands_meanr": random.normal(0, 0.3, 45),
    }


@pytest.fixture
def smplx_file(tmp_path: Path) -> Path:
    """A file like SMPLX_NEUTRAL.npz: 400 shape columns, and an array of objects that nobody needs."""
    path = tmp_path / "model.npz"
    np.savez(path, **smplx_arrays(400), joint2num=np.array({"pelvis": 0}, dtype=object))
    return path
