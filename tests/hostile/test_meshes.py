"""Mutated mesh files: a mesh whose indices hold, or an error; never anything else."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stages.shared.errors import GwError
from stages.shared.meshes import Mesh, load_mesh, write_ply
from tests.hostile.test_capture_mutations import MUTANTS, mutate


def originals(folder: Path) -> dict[str, Path]:
    ball = trimesh.creation.icosphere(subdivisions=1)
    colors = np.full((len(ball.vertices), 3), 9, np.uint8)
    write_ply(folder / "binary.ply", Mesh(ball.vertices, ball.faces, colors, colors[:, 0] % 5))
    (folder / "text.ply").write_bytes(trimesh.exchange.ply.export_ply(ball, encoding="ascii"))
    for kind in ("obj", "stl", "glb", "off"):
        ball.export(folder / f"ball.{kind}")
    return {path.name: path for path in folder.iterdir()}


@pytest.mark.parametrize("name", ["binary.ply", "text.ply", "ball.obj", "ball.stl", "ball.glb", "ball.off"])
def test_mutated_meshes(tmp_path: Path, name: str) -> None:
    path = originals(tmp_path)[name]
    data = path.read_bytes()
    random = np.random.default_rng(len(data))
    for _ in range(MUTANTS):
        path.write_bytes(mutate(data, random))
        try:
            mesh = load_mesh(path)
        except GwError as error:
            assert str(path) in error.where and error.exit_code == 65
            continue
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)


def test_a_header_cannot_claim_more_than_the_file_holds(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    rest = "property float x\nproperty float y\nproperty float z\nelement face 9\n"
    rest += "property list uchar int vertex_indices\nend_header\n"
    for count in (10_000_000, 400_000_000):
        for order in ("ascii", "binary_little_endian"):
            header = f"ply\nformat {order} 1.0\nelement vertex {count}\n{rest}"
            path.write_bytes(header.encode() + b"\0" * 64)
            with pytest.raises(GwError) as caught:
                load_mesh(path)
            assert "ends early" in caught.value.what


def test_a_glb_cannot_claim_more_than_the_file_holds(tmp_path: Path) -> None:
    """An accessor without data means zeros, as many as it says."""
    path = originals(tmp_path)["ball.glb"]
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    header = json.loads(data[20 : 20 + length])
    for accessor in header["accessors"]:
        accessor["count"] = 4_000_000_000
        accessor.pop("bufferView", None)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    total = 20 + len(text) + len(rest)
    path.write_bytes(data[:8] + struct.pack("<II", total, len(text)) + data[16:20] + text + rest)
    with pytest.raises(GwError, match="claims 4000000000"):
        load_mesh(path)
