"""Garments: outside the body, even, with usable texture coordinates, and graded to two different people."""

from __future__ import annotations

import igl
import numpy as np
import pytest

from stages.shared.body import embedded_body
from stages.shared.meshes import boundary_edges, components, edges
from stages.synth.bodies import PERSON_1, PERSON_2, ShapedBody, betas_of
from stages.synth.garments import Pattern, fit, wardrobe

SPACING = 0.026
OPENINGS = {"flared skirt": 2, "striped T-shirt": 4, "dotted T-shirt": 4, "trousers": 3, "open vest": 3}


@pytest.fixture(scope="module")
def mean() -> ShapedBody:
    return ShapedBody(embedded_body(), np.zeros(10, np.float32))


@pytest.fixture(scope="module")
def patterns(mean: ShapedBody) -> dict[str, Pattern]:
    first, second = wardrobe(mean, SPACING, 0)
    return {pattern.name: pattern for pattern in first + second}


@pytest.mark.parametrize("name", OPENINGS)
def test_a_garment_is_one_even_piece_with_its_openings(patterns: dict[str, Pattern], name: str) -> None:
    cut = patterns[name].cut
    assert len(np.unique(components(cut.faces, len(cut.vertices)))) == 1
    border = boundary_edges(cut.faces)
    loops = components(np.column_stack([border, border[:, :1]]), len(cut.vertices))
    assert len(np.unique(loops[border[:, 0]])) == OPENINGS[name]
    pairs = edges(cut.faces)
    lengths = np.linalg.norm(cut.vertices[pairs[:, 0]] - cut.vertices[pairs[:, 1]], axis=1)
    assert np.percentile(lengths, 2) > 0.3 * np.median(lengths)
    assert lengths.max() < 3.5 * np.median(lengths)


@pytest.mark.parametrize("name", OPENINGS)
@pytest.mark.parametrize("person", [PERSON_1, PERSON_2], ids=lambda person: person.name)
def test_a_graded_garment_lies_outside_its_wearer(
    mean: ShapedBody, patterns: dict[str, Pattern], name: str, person: object
) -> None:
    wearer = ShapedBody(mean.model, betas_of(mean.model, person))  # type: ignore[arg-type]
    garment = fit(patterns[name], mean, wearer)
    distance = igl.signed_distance(
        garment.vertices,
        wearer.rest_vertices,
        wearer.faces,
        sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]
    assert distance.min() > -0.004
    assert np.median(distance) < 0.06
    assert garment.skin_weights.sum(axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize("name", OPENINGS)
def test_texture_coordinates_keep_the_size_of_the_cloth(patterns: dict[str, Pattern], name: str) -> None:
    cut = patterns[name].cut
    corners = cut.vertices[cut.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    first, second = cut.corner_uv[:, 1] - cut.corner_uv[:, 0], cut.corner_uv[:, 2] - cut.corner_uv[:, 0]
    area_uv = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    assert 0.6 < area_uv.sum() / area.sum() < 1.5
    assert np.mean(area_uv > 0.2 * area) > 0.85


def test_the_skirt_fabric_has_no_seam(patterns: dict[str, Pattern]) -> None:
    skirt = patterns["flared skirt"]
    around = np.ptp(skirt.cut.corner_uv[..., 0]) / skirt.fabric.period
    assert around == pytest.approx(round(around), abs=1e-9)
