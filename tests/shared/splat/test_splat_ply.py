"""The 3DGS file layout: round trip, the layout byte by byte, and files that must be refused."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from stages.shared.errors import BadData, MissingInput
from stages.shared.splat.ply import SplatCloud, read_splat_ply, write_splat_ply


def cloud(n: int = 7, harmonics: int = 0) -> SplatCloud:
    rng = np.random.default_rng(n)
    quats = rng.normal(size=(n, 4))
    return SplatCloud(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(rng.uniform(-6, -2, (n, 3))).astype(np.float32),
        opacities=rng.uniform(0.01, 0.99, n).astype(np.float32),
        colors=rng.uniform(size=(n, 3)).astype(np.float32),
        harmonics=rng.normal(size=(n, harmonics, 3)).astype(np.float32) if harmonics else None,
        layers=rng.integers(0, 4, n).astype(np.uint8),
    )


@pytest.mark.parametrize("n, harmonics", [(0, 0), (7, 0), (5, 3), (4, 15)])
def test_round_trip(tmp_path, n, harmonics):
    before = cloud(n, harmonics)
    write_splat_ply(tmp_path / "a.ply", before, with_layers=True)
    after = read_splat_ply(tmp_path / "a.ply")
    for name in ("means", "quats", "scales", "opacities", "colors"):
        np.testing.assert_allclose(
            getattr(after, name), getattr(before, name), rtol=2e-5, atol=1e-6, err_msg=name
        )
    if harmonics:
        np.testing.assert_array_equal(after.harmonics, before.harmonics)
    else:
        assert after.harmonics is None
    np.testing.assert_array_equal(after.layers, before.layers)


def test_layout(tmp_path):
    """Offsets as 3DGS viewers expect them, taken apart by hand."""
    before = cloud(3, 15)
    write_splat_ply(tmp_path / "a.ply", before)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float")]
    assert names == (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(45)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
    assert len(body) == 3 * 62 * 4
    values = dict(zip(names, struct.unpack_from("<62f", body, 62 * 4), strict=True))
    assert values["y"] == before.means[1, 1]
    assert values["f_dc_2"] == pytest.approx((before.colors[1, 2] - 0.5) / 0.28209479177387814, rel=1e-5)
    assert values["f_rest_16"] == before.harmonics[1, 1, 1]  # all of red, then green, then blue
    assert values["scale_0"] == pytest.approx(np.log(before.scales[1, 0]), rel=1e-6)
    assert 1 / (1 + np.exp(-values["opacity"])) == pytest.approx(before.opacities[1], rel=1e-5)
    assert values["rot_0"] == before.quats[1, 0]
    assert "layer" not in names


def test_extreme_values_stay_finite(tmp_path):
    before = cloud(2)
    odd = SplatCloud(
        before.means, before.quats, np.zeros((2, 3), np.float32), np.array([0, 1], np.float32),
        np.array([[-1, 2, 0.5]] * 2, np.float32),
    )  # fmt: skip
    write_splat_ply(tmp_path / "a.ply", odd)
    after = read_splat_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(after.opacities, [1e-6, 1 - 1e-6], rtol=1e-3)
    np.testing.assert_allclose(after.scales, 1e-6, rtol=1e-3)
    np.testing.assert_allclose(after.colors[0], [0, 1, 0.5], atol=1e-6)


def header(*properties: str, count: int = 1, form: str = "binary_little_endian") -> bytes:
    lines = ["ply", f"format {form} 1.0", "comment made elsewhere", f"element vertex {count}", *properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


NEEDED = [f"property float {name}" for name in ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2")]


def test_subset_in_another_order(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(
        header("property uchar odd", *reversed(NEEDED), "property double rot_9")
        + struct.pack("<B7fd", 9, -1.0, -2.0, -3.0, 0.0, 3.0, 2.0, 1.0, 5.0)
    )
    found = read_splat_ply(path)
    assert found.means.tolist() == [[1, 2, 3]] and found.opacities.tolist() == [0.5]
    np.testing.assert_allclose(found.scales[0], np.exp([-3, -2, -1]), rtol=1e-6)
    assert found.quats.tolist() == [[1, 0, 0, 0]] and found.colors.tolist() == [[0.5] * 3]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat binary_little_endian 1.0\n",
        b"solid not a ply",
        header(*NEEDED, form="ascii"),
        header(*NEEDED[:-1]) + bytes(24),
        header(*NEEDED, count=3) + bytes(28),
        header(*NEEDED, count=10**15) + bytes(28),
        header(*NEEDED, "property list uchar int ids") + bytes(64),
        header(*NEEDED, "property float x") + bytes(64),
        header(*NEEDED, "property quad q") + bytes(64),
        header(*NEEDED) + struct.pack("<7f", 0, float("nan"), 0, 0, 0, 0, 0),
        header(*NEEDED) + struct.pack("<7f", 0, 0, 0, 0, 99, 0, 0),
        header(*NEEDED, *[f"property float rot_{i}" for i in range(4)]) + bytes(44),
        header(*NEEDED).replace(b"vertex", b"face") + bytes(28),
    ],
    ids=[
        "empty", "no end", "not a ply", "ascii", "a property missing", "cut short", "a huge count", "a list",
        "a name twice", "an unknown type", "not a number", "a huge scale", "a zero rotation", "faces first",
    ],
)  # fmt: skip
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(BadData, match=r"a\.ply"):
        read_splat_ply(path)


def test_missing_file(tmp_path):
    with pytest.raises(MissingInput):
        read_splat_ply(tmp_path / "no.ply")


def test_arrays_that_do_not_fit_are_refused(tmp_path):
    good = cloud(3)
    bad = SplatCloud(good.means, good.quats[:2], good.scales, good.opacities, good.colors)
    with pytest.raises(BadData, match="quats"):
        write_splat_ply(tmp_path / "a.ply", bad)
    good.scales[1, 1] = np.inf
    with pytest.raises(BadData, match="scales"):
        write_splat_ply(tmp_path / "a.ply", good)
    assert not (tmp_path / "a.ply").exists()
