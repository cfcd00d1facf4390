from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stages.shared.errors import BadData, GwError
from stages.shared.meshes import Mesh, load_mesh, write_ply
from stages.shared.meshes.load import load_centred_mesh


@pytest.fixture
def mesh() -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=2)
    random = np.random.default_rng(0)
    colors = random.integers(0, 255, (len(ball.vertices), 3)).astype(np.uint8)
    return Mesh(ball.vertices, ball.faces, colors, random.integers(0, 6, len(ball.vertices)).astype(np.uint8))


def same(left: Mesh, right: Mesh) -> None:
    np.testing.assert_array_equal(left.vertices, right.vertices)
    np.testing.assert_array_equal(left.faces, right.faces)
    np.testing.assert_array_equal(left.colors, right.colors)
    np.testing.assert_array_equal(left.labels, right.labels)


def test_round_trip_and_same_bytes(tmp_path: Path, mesh: Mesh) -> None:
    write_ply(tmp_path / "a.ply", mesh)
    write_ply(tmp_path / "b.ply", mesh)
    same(load_mesh(tmp_path / "a.ply"), mesh)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_others_read_what_we_write(tmp_path: Path, mesh: Mesh) -> None:
    write_ply(tmp_path / "a.ply", mesh, normals=mesh.vertices)
    other = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_array_equal(np.asarray(other.vertices, np.float32), mesh.vertices)
    np.testing.assert_array_equal(other.faces, mesh.faces)
    np.testing.assert_array_equal(other.visual.vertex_colors[:, :3], mesh.colors)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_we_read_what_others_write(tmp_path: Path, mesh: Mesh, encoding: str) -> None:
    other = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
    (tmp_path / "a.ply").write_bytes(trimesh.exchange.ply.export_ply(other, encoding=encoding))
    found = load_mesh(tmp_path / "a.ply")
    np.testing.assert_allclose(found.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_array_equal(found.colors, mesh.colors)


def test_big_endian_doubles_and_polygons(tmp_path: Path) -> None:
    header = (
        "ply\nformat binary_big_endian 1.0\ncomment made by hand\nelement vertex 5\nproperty double x\n"
        "property double y\nproperty double z\nelement face 2\nproperty uchar flag\n"
        "property list uchar uint vertex_index\nend_header\n"
    )
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]], ">f8")
    body = corners.tobytes() + struct.pack(">BBIIII", 9, 4, 0, 1, 2, 3) + struct.pack(">BBIII", 9, 3, 3, 2, 4)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    found = load_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.vertices, corners.astype(np.float32))
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [0, 2, 3], [3, 2, 4]])


def test_ascii_with_label_and_quads(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar label\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 3\n1 0 0 4\n1 1 0 5\n0 1 0 0\n4 0 1 2 3\n"
    )
    found = load_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(found.labels, [3, 4, 5, 0])
    assert found.colors is None


@pytest.mark.parametrize("kind", [".obj", ".stl", ".glb", ".off"])
def test_other_formats(tmp_path: Path, kind: str) -> None:
    box = trimesh.creation.box()
    box.export(tmp_path / f"box{kind}")
    found = load_mesh(tmp_path / f"box{kind}")
    assert (len(found.vertices), len(found.faces)) == (8, 12)
    assert trimesh.Trimesh(found.vertices, found.faces, process=False).volume == pytest.approx(1.0)


@pytest.mark.parametrize("kind", [".obj", ".off", ".ply", "ascii.ply", ".glb"])
@pytest.mark.parametrize("place", [(512_345.25, 5_402_118.5, 371.0), (-4.2e6, 1e5, 4.8e6), (0.0, 9e7, 0.0)])
def test_a_scan_far_from_the_origin_is_centred_in_double(
    tmp_path: Path, kind: str, place: tuple[float, float, float]
) -> None:
    ball = trimesh.creation.icosphere(2, 0.9)
    moved = ball.vertices + place
    path = tmp_path / f"scan{kind}"
    if kind == ".obj":
        rows = ["v {:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in moved]
        path.write_text("\n".join(rows + ["f {} {} {}".format(*(face + 1)) for face in ball.faces]))
    elif kind == ".off":
        rows = ["{:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in moved]
        rows = ["OFF", f"{len(moved)} {len(ball.faces)} 0", *rows]
        path.write_text("\n".join(rows + ["3 {} {} {}".format(*face) for face in ball.faces]))
    elif kind == ".glb":  # far away by the transform of its node
        scene = trimesh.Scene()
        scene.add_geometry(ball, transform=trimesh.transformations.translation_matrix(place))
        path.write_bytes(scene.export(file_type="glb"))
    else:
        header = ["ply", "format ascii 1.0" if "ascii" in kind else "format binary_little_endian 1.0"]
        header += [f"element vertex {len(moved)}", *(f"property double {axis}" for axis in "xyz")]
        header += [f"element face {len(ball.faces)}", "property list uchar int vertex_indices", "end_header"]
        if "ascii" in kind:
            rows = ["{:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in moved]
            path.write_text("\n".join([*header, *rows, *("3 {} {} {}".format(*face) for face in ball.faces)]))
        else:
            faces = np.zeros(len(ball.faces), [("count", "u1"), ("corners", "<i4", 3)])
            faces["count"], faces["corners"] = 3, ball.faces
            path.write_bytes(("\n".join(header) + "\n").encode() + moved.tobytes() + faces.tobytes())
    found, middle = load_centred_mesh(path)
    assert np.abs(middle - place).max() <= 0.5
    order = np.lexsort(np.round(found.vertices + (middle - place), 4).T)
    expected = ball.vertices[np.lexsort(np.round(ball.vertices, 4).T)]
    assert np.abs(found.vertices[order] + (middle - place) - expected).max() < 2e-5


def test_a_scan_near_the_origin_stays_where_it_is(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    box.apply_translation([30.0, 0, 0])
    box.export(tmp_path / "box.obj")
    found, middle = load_centred_mesh(tmp_path / "box.obj")
    assert not middle.any() and np.array_equal(found.vertices, load_mesh(tmp_path / "box.obj").vertices)


def test_an_obj_cannot_name_other_files(tmp_path: Path) -> None:
    (tmp_path / "secret.mtl").write_text("newmtl a\n")
    (tmp_path / "a.obj").write_text(
        "mtllib secret.mtl\nmtllib ../../etc/hosts\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    )
    opened: list[str] = []

    import sys

    watching = [True]

    def watch(event: str, arguments: tuple) -> None:
        if watching[0] and event == "open" and isinstance(arguments[0], str):
            opened.append(arguments[0])

    sys.addaudithook(watch)
    found = load_mesh(tmp_path / "a.obj")
    watching[0] = False
    assert len(found.faces) == 1
    assert not [name for name in opened if name.endswith((".mtl", "hosts"))]


def test_real_scan_reads_as_trimesh_reads_it(subject_a: Path) -> None:
    path = subject_a / "Sequence1/gt/scan-f000000.ply"
    found, other = load_mesh(path), trimesh.load(path, process=False)
    np.testing.assert_array_equal(found.vertices, other.vertices)
    np.testing.assert_array_equal(found.faces, other.faces)
    assert found.labels is not None and np.bincount(found.labels).tolist() == [8694, 4277, 1586, 4097, 3888]


def write(path: Path, header: str, body: str = "") -> Path:
    path.write_text("ply\nformat ascii 1.0\n" + header + "end_header\n" + body)
    return path


XYZ = "property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("header", "body", "says"),
    [
        (f"element vertex 3\n{XYZ}", "0 0 0\n1 0 0\n0 1 0\n", "no faces"),
        (f"element vertex 0\n{XYZ}", "", "no vertices"),
        (
            f"element vertex 3\n{XYZ}element face 1\nproperty list uchar int vertex_indices\n",
            "0 0 0\n1 nan 0\n0 1 0\n3 0 1 2\n",
            "NaN",
        ),
        (
            f"element vertex 3\n{XYZ}element face 1\nproperty list uchar int vertex_indices\n",
            "0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n",
            "not there",
        ),
        (
            f"element vertex 3\n{XYZ}element face 1\nproperty list uchar int vertex_indices\n",
            "0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n",
            "not there",
        ),
        (f"element vertex 9\n{XYZ}", "0 0 0\n", "ends early"),
        ("element vertex 999999999999\n", "", "header has the line"),
        (f"element vertex 1\n{XYZ}{XYZ}", "0 0 0 0 0 0\n", "twice"),
        ("element vertex 1\nproperty float x\n", "0\n", "no vertices with x"),
        (f"element vertex 1\n{XYZ}", "a b c\n", "cannot be read"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, header: str, body: str, says: str) -> None:
    path = write(tmp_path / "a.ply", header, body)
    with pytest.raises(BadData) as caught:
        load_mesh(path)
    assert says in caught.value.what and str(path) in caught.value.where


def test_absent_and_unknown_files(tmp_path: Path) -> None:
    with pytest.raises(GwError) as caught:
        load_mesh(tmp_path / "a.ply")
    assert caught.value.exit_code == 66
    (tmp_path / "a.fbx").write_bytes(b"x")
    with pytest.raises(BadData, match="not read"):
        load_mesh(tmp_path / "a.fbx")
