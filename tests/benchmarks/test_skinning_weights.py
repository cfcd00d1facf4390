"""Nearest, undiffused and diffused weights, side by side."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.canonicalize.config import PRESETS
from stages.canonicalize.unpose import cut_tears, edge_growth
from stages.register_template import stage as register_template
from stages.register_template.config import PRESETS as REGISTER
from stages.shared.meshes.load import write_ply
from tests.benchmarks import skinning_weights
from tests.stages.dressed_body import dressed


@pytest.fixture(scope="module", params=[3])
def compared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, person = tmp_path_factory.mktemp("compare"), dressed(request.param)
    write_ply(folder / "scan.ply", person.mesh)
    (folder / "scan.npz").write_bytes(person.poses.to_npz_bytes())
    subject = folder / "subject"
    register_template.run(folder / "scan.ply", subject, REGISTER["tiny"], params=folder / "scan.npz")
    return skinning_weights.run(subject, folder / "out", PRESETS["tiny"]).path


def test_diffused_weights_tear_less_than_nearest_ones(compared: Path) -> None:
    found = json.loads((compared / "compare.json").read_text())["variants"]
    assert list(found) == sorted(skinning_weights.VARIANTS)
    nearest, undiffused, diffused = (found[name] for name in ("nearest", "undiffused", "diffused"))
    assert diffused["armpit_growth_p99"] < undiffused["armpit_growth_p99"] * 1.02
    assert diffused["armpit_growth_p99"] < nearest["armpit_growth_p99"]
    assert diffused["torn_edges"] <= nearest["torn_edges"]
    assert diffused["turned_over_faces"] <= nearest["turned_over_faces"]
    assert nearest["skinned_iou"] is None, "a lone mesh has no test take"


def test_the_picture_has_a_column_for_each(compared: Path) -> None:
    picture = cv2.imread(str(compared / "compare.png"))
    assert picture.shape[1] > picture.shape[0] and picture.std() > 20


def test_growth_counts_only_edges_that_are_long_afterwards() -> None:
    faces = np.array([[0, 1, 2], [0, 1, 3]])
    before = np.array([[0.0, 0, 0], [0.001, 0, 0], [0, 0.01, 0], [0, 0, 0.01]])
    after = before.copy()
    after[1, 0] = 0.008
    np.testing.assert_allclose(edge_growth(faces, before, after, 0.01), 1.0, atol=0.3)
    assert edge_growth(faces, before, after, 0.005)[0, 0] == pytest.approx(8.0)
    tears = cut_tears(faces, before, after, 5.0, 0.005)
    assert (tears.torn_edges, tears.cut_faces, tears.largest_growth) == (1, 2, pytest.approx(8.0))
