"""Scans as people have them: each defect by itself, and the whole command on several at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.register_template.config import PRESETS
from stages.register_template.scan_cleaning import clean_scan, outward_faces, unit_of, weld
from stages.register_template.stage import run
from stages.register_template.surface import turned_upright
from stages.shared.body import embedded_body
from stages.shared.body.posed import posed_body
from stages.shared.errors import BadData
from stages.shared.meshes.load import write_ply
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.remesh import cluster
from stages.shared.meshes.topology import face_normals
from tests.listening import Listener

from .scenes import a_pose


@pytest.fixture(scope="module")
def person() -> Mesh:
    body = embedded_body()
    return Mesh(posed_body(body, a_pose()[1]).astype(np.float32), body.faces)


def divided(mesh: Mesh, times: int) -> Mesh:
    """Every face cut in four, so often."""
    vertices, faces = mesh.vertices, mesh.faces
    for _ in range(times):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        middle = len(vertices) + inverse.reshape(-1, 3)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        a, b, c = faces.T
        ab, bc, ca = middle.T
        faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return Mesh(vertices, faces)


@pytest.mark.parametrize(("unit", "size"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_units_are_found_and_said(person: Mesh, unit: str, size: float) -> None:
    heard = Listener()
    given = replace(person, vertices=np.float32(size) * person.vertices)
    cleaned = clean_scan(given, 200_000, "scan", heard)
    assert cleaned.report["unit"] == unit
    assert any(unit in text.split() or f"in {unit};" in text for text in heard.said + heard.warnings) == (
        unit != "m"
    )
    np.testing.assert_allclose(
        np.ptp(cleaned.mesh.vertices, axis=0), np.ptp(person.vertices, axis=0), rtol=1e-4
    )


def test_a_size_that_nobody_has(person: Mesh) -> None:
    with pytest.raises(BadData, match="none of the units"):
        unit_of(replace(person, vertices=5 * person.vertices), "scan")


def test_a_clean_scan_is_left_as_it_is(person: Mesh) -> None:
    ordinary = weld(person)[0]
    cleaned = clean_scan(ordinary, 200_000, "scan", Listener())
    np.testing.assert_array_equal(cleaned.mesh.vertices, ordinary.vertices)
    np.testing.assert_array_equal(cleaned.mesh.faces, ordinary.faces)
    assert cleaned.report["faces_turned"] == 0 and cleaned.report["simplified"] == "unchanged"


def test_doubled_vertices_and_faces_go(person: Mesh) -> None:
    ordinary = weld(person)[0]
    corners = ordinary.faces.reshape(-1)
    soup = Mesh(
        ordinary.vertices[corners],
        np.concatenate([np.arange(len(corners)).reshape(-1, 3), [[0, 1, 2], [5, 5, 6]]]),
        None,
        (ordinary.vertices[corners, 1] > 1).astype(np.uint8),
    )
    welded, doubled, dropped = weld(soup)
    assert len(welded.vertices) == len(ordinary.vertices) and len(welded.faces) == len(ordinary.faces)
    assert doubled == len(corners) - len(ordinary.vertices) and dropped == 2
    np.testing.assert_array_equal(welded.labels, (welded.vertices[:, 1] > 1).astype(np.uint8))


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_faces_inside_out_are_turned(person: Mesh, share: float) -> None:
    ordinary = outward_faces(weld(person)[0])[0]
    flip = np.random.default_rng(0).random(len(ordinary.faces)) < share
    spoilt = replace(ordinary, faces=np.where(flip[:, None], ordinary.faces[:, ::-1], ordinary.faces))
    mended, turned = outward_faces(spoilt)
    assert turned == flip.sum()
    agree = (
        face_normals(mended.vertices, mended.faces)[0] * face_normals(ordinary.vertices, ordinary.faces)[0]
    )
    assert (agree.sum(axis=1) > -1e-9).all()


def test_two_people_are_refused_and_one_with_a_bag_is_not(person: Mesh) -> None:
    count = len(person.vertices)
    beside = person.vertices + np.float32([1.2, 0, 0.3])
    two = Mesh(
        np.concatenate([person.vertices, beside]), np.concatenate([person.faces, person.faces + count])
    )
    with pytest.raises(BadData, match="more than one person"):
        clean_scan(two, 200_000, "scan", Listener())
    small = np.float32(0.2) * person.vertices + np.float32([0.5, 0.4, 0])
    bag = Mesh(np.concatenate([person.vertices, small]), np.concatenate([person.faces, person.faces + count]))
    assert len(clean_scan(bag, 200_000, "scan", Listener()).mesh.faces) > len(person.faces)


def cut_at(mesh: Mesh, height: float, gap: float) -> tuple[Mesh, Mesh]:
    """The faces above and below a height, moved apart by a gap, with a rim of open edges on both."""
    upper = mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > height
    parts = []
    for faces, shift in ((mesh.faces[upper], gap), (mesh.faces[~upper], 0.0)):
        rows, faces = np.unique(faces, return_inverse=True)
        parts.append(Mesh(mesh.vertices[rows] + np.float32([0, shift, 0]), faces.reshape(-1, 3)))
    return parts[0], parts[1]


def together(*parts: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
    )


def test_a_scan_in_separate_parts_is_one_person(person: Mesh) -> None:
    upper, lower = cut_at(person, 1.0, 0.01)
    jacket = replace(upper, vertices=np.float32(1.05) * upper.vertices - np.float32([0, 0.05, 0]))
    for parts in ((upper, lower), (jacket, upper, lower)):
        cleaned = clean_scan(together(*parts), 200_000, "scan", Listener())
        assert cleaned.report["unit"] == "m"


@pytest.mark.parametrize("apart", [0.55, 1.2, 1.9])
def test_two_people_in_parts_are_still_two(person: Mesh, apart: float) -> None:
    """Even when their hands touch."""
    parts = cut_at(person, 1.0, 0.01)
    neighbours = [replace(part, vertices=part.vertices + np.float32([0, 0, apart])) for part in parts]
    with pytest.raises(BadData, match="more than one person"):
        clean_scan(together(*parts, *neighbours), 200_000, "scan", Listener())


@pytest.mark.parametrize(
    ("times", "faces"), [(2, 390_000), pytest.param(3, 1_500_000, marks=pytest.mark.long)]
)
def test_many_faces_become_few_in_no_time(person: Mesh, times: int, faces: int) -> None:
    heavy = divided(person, times)
    assert len(heavy.faces) > faces
    fewer = cluster(heavy, 40_000)
    assert 20_000 < len(fewer.faces) < 80_000
    assert np.abs(np.ptp(fewer.vertices, axis=0) - np.ptp(heavy.vertices, axis=0)).max() < 0.02
    area = face_normals(fewer.vertices, fewer.faces)[1].sum()
    assert area == pytest.approx(face_normals(heavy.vertices, heavy.faces)[1].sum(), rel=0.1)


def test_a_scan_beside_its_poses_is_turned_when_another_axis_is_up(person: Mesh) -> None:
    heard = Listener()
    lying = replace(person, vertices=person.vertices[:, [0, 2, 1]] * np.float32([1, -1, 1]))
    upright, up = turned_upright(lying, person.vertices.astype(np.float64), heard)
    assert up == "+z" and any("+z" in text for text in heard.said + heard.warnings)
    np.testing.assert_allclose(upright.vertices, person.vertices, atol=1e-5)
    assert turned_upright(person, person.vertices.astype(np.float64), heard)[1] == "+y"


def test_the_command_on_a_scan_with_everything_wrong(person: Mesh, tmp_path: Path) -> None:
    """Millimetres, z up, holes, a third of the faces inside out, no parameters."""
    random = np.random.default_rng(1)
    middles = person.vertices[person.faces].mean(axis=1)
    holes = np.zeros(len(middles), bool)
    for centre in middles[random.integers(0, len(middles), 5)]:
        holes |= np.linalg.norm(middles - centre, axis=1) < 0.07
    faces = person.faces[~holes]
    flip = random.random(len(faces)) < 0.3
    faces = np.where(flip[:, None], faces[:, ::-1], faces)
    lying = person.vertices[:, [0, 2, 1]] * np.float32([1, -1, 1])
    write_ply(tmp_path / "scan.ply", Mesh(1000 * lying, faces))
    heard = Listener()
    result = run(tmp_path / "scan.ply", tmp_path / "s", PRESETS["tiny"], heard)
    said = " / ".join(heard.said + heard.warnings)
    assert "in mm" in said and "+z is up" in said and "inside out" in said
    told = result.artifact.json("report")["template"]
    assert told["unit"] == "mm" and told["up"] == "+z" and told["faces_turned"] > 5000
    assert result.summary["template_to_body_mean_m"] < 0.01
    assert result.summary["template_to_body_p95_m"] < 0.03
    template = result.artifact.arrays("template")
    np.testing.assert_allclose(
        np.ptp(template["vertices"], axis=0), np.ptp(person.vertices, axis=0), atol=2e-3
    )
