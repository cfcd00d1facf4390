"""Every splat format comes back as what went in, and looks the same through our own renderer."""

from __future__ import annotations

import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.export.cloud import cloud_of, principal_axes
from stages.shared.export.glb import GlbReader
from stages.shared.export.splat_glb import read_splat_glb
from stages.shared.export.splats import read_splats, splat_facts, write_splats
from stages.shared.export.spz import pack_smallest_three, unpack_smallest_three
from stages.shared.outfit.render_image import render_image
from stages.shared.splat.api import rasterize
from stages.shared.splat.ply import SplatCloud
from tests.shared.outfit.wardrobe import cameras, motion, outfit

# What each format may lose: PSNR in dB of the re-read file's picture to the direct render.
BARS = {"ply": 60.0, "glb": 60.0, "spz": 40.0}


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.square(one.astype(float) - other).mean(), 1e-20)))


def picture_of(cloud: SplatCloud) -> np.ndarray:
    camera = cameras()[1]
    arrays = (torch.from_numpy(a) for a in (cloud.means, cloud.quats, cloud.scales, cloud.opacities))
    means, quats, scales, opacities = arrays
    view = torch.from_numpy(camera.camera_from_world).float()
    intrinsics = torch.from_numpy(camera.intrinsics).float()
    size = (camera.width, camera.height)
    colors = torch.from_numpy(cloud.colors)
    return rasterize(means, quats, scales, opacities, colors, view, intrinsics, *size).features.numpy()


@pytest.fixture(scope="module")
def posed():
    return outfit("body", "lower", "upper").composite(motion(), 4)


@pytest.mark.parametrize("kind", ["ply", "spz", "glb"])
def test_a_reread_file_looks_like_the_render(posed, tmp_path: Path, kind: str) -> None:
    """A bent body: its Gaussians are sheared by skinning."""
    path = tmp_path / f"frame.{kind}"
    write_splats(path, cloud_of(posed), posed.layers)
    direct = render_image(posed, cameras()[1]).color
    assert psnr(picture_of(read_splats(path)), direct) > BARS[kind]
    turned = picture_of(read_splats(path))[:, ::-1]
    assert psnr(turned, direct) < 25  # the comparison can tell pictures apart


@pytest.mark.parametrize("kind", ["ply", "spz", "glb"])
def test_same_content_same_bytes(posed, tmp_path: Path, kind: str) -> None:
    for name in ("one", "two"):
        write_splats(tmp_path / f"{name}.{kind}", cloud_of(posed), posed.layers)
    assert (tmp_path / f"one.{kind}").read_bytes() == (tmp_path / f"two.{kind}").read_bytes()


def test_principal_axes_give_the_covariance_back() -> None:
    """Discs, needles, balls and mirrored axes."""
    rng = np.random.default_rng(0)
    scales = np.exp(rng.uniform(-9, -2, (200, 3)))
    scales[:20, 1] = scales[:20, 2] = scales[:20, 0]
    turned = Rotation.random(200, random_state=1).as_matrix()
    covariances = turned @ (np.square(scales)[:, :, None] * turned.transpose(0, 2, 1))
    quats, lengths = principal_axes(covariances)
    back = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    again = back @ (np.square(lengths.astype(float))[:, :, None] * back.transpose(0, 2, 1))
    largest = np.abs(covariances).max(axis=(1, 2))
    assert np.abs(again - covariances).max(axis=(1, 2)).max() < 1e-5 * largest.max()
    assert (np.abs(again - covariances).max(axis=(1, 2)) / largest).max() < 1e-5
    np.testing.assert_allclose(np.sort(lengths, 1), np.sort(scales, 1), rtol=1e-3)


def test_smallest_three_is_fine_and_keeps_signs() -> None:
    quats = np.roll(Rotation.random(500, random_state=2).as_quat(), 1, axis=1).astype(np.float32)
    quats[:4] = np.eye(4)
    back = unpack_smallest_three(pack_smallest_three(quats))
    cosine = np.abs((quats * back).sum(axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(cosine, 1))).max() < 0.25
    one = pack_smallest_three(np.array([[0.9, 0.1, -0.2, 0.3]], np.float32))
    (code,) = struct.unpack("<I", one.tobytes())
    assert code >> 30 == 3 and code >> 19 & 1 == 1  # w is largest (index 3 of x y z w); y is negative


def test_spz_is_laid_out_as_specified(tmp_path: Path) -> None:
    """One Gaussian by hand: the format's own numbers, not our reader's."""
    cloud = SplatCloud(
        np.array([[1.0, -0.5, 0.25]], np.float32), np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), np.exp(-5), np.float32), np.array([0.5], np.float32),
        np.array([[0.5, 0.5 + 0.28209479, 0.0]], np.float32),
    )  # fmt: skip
    write_splats(tmp_path / "a.spz", cloud)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, count, degree, flags, reserved) == (0x5053474E, 3, 1, 0, 0, 0)
    x, y, z = (
        int.from_bytes(data[16 + 3 * i : 19 + 3 * i], "little", signed=True) / 2**bits for i in range(3)
    )
    assert (x, y, z) == (1.0, -0.5, 0.25)
    assert data[25] == 128 and data[26] == 128 and data[27] == 166  # opacity; 127.5; 127.5 + 0.15 * 255
    assert list(data[29:32]) == [80, 80, 80] and len(data) == 36  # (-5 + 10) * 16


def test_gltf_says_what_the_extension_asks_for(posed, tmp_path: Path) -> None:
    path = tmp_path / "frame.glb"
    write_splats(path, cloud_of(posed), posed.layers)
    glb = GlbReader(path)
    assert glb.content["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert [node["name"] for node in glb.content["nodes"]] == ["body", "lower", "upper"]
    primitive = glb.content["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    fields = primitive["attributes"]
    opacity = glb.array(fields["KHR_gaussian_splatting:OPACITY"])
    assert opacity.shape == (int((posed.layer_ids == 0).sum()),) and 0 <= opacity.min() <= opacity.max() <= 1
    rotation = glb.array(fields["KHR_gaussian_splatting:ROTATION"])
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-5)
    entry = glb.content["accessors"][fields["POSITION"]]
    assert entry["min"] <= entry["max"] and len(entry["min"]) == 3
    cloud, layers = read_splat_glb(path)
    assert layers == posed.layers and np.array_equal(cloud.layers, posed.layer_ids.numpy())


def test_another_gltf_reader_sees_the_points(posed, tmp_path: Path) -> None:
    """trimesh knows nothing of the extension: it gets the fallback, coloured points in place."""
    path = tmp_path / "frame.glb"
    cloud = cloud_of(posed)
    write_splats(path, cloud, posed.layers)
    scene = trimesh.load_scene(path)
    points = np.concatenate([geometry.vertices for geometry in scene.geometry.values()])
    np.testing.assert_allclose(np.sort(points, axis=0), np.sort(cloud.means, axis=0), atol=1e-6)


def test_what_cannot_be_written_or_read(posed, tmp_path: Path) -> None:
    cloud = cloud_of(posed)
    cloud = replace(cloud, means=cloud.means.copy())
    with pytest.raises(UsageProblem, match="obj"):
        write_splats(tmp_path / "a.obj", cloud)
    cloud.means[3, 1] = np.nan
    for kind in ("ply", "spz", "glb"):
        with pytest.raises(BadData, match="means"):
            write_splats(tmp_path / f"a.{kind}", cloud)
        with pytest.raises(MissingInput):
            read_splats(tmp_path / f"a.{kind}")


def _spz(count: int, body: int, version: int = 3, degree: int = 0, bits: int = 12) -> bytes:
    head = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, bits, 0, 0)
    return gzip.compress(head + bytes(body))


@pytest.mark.parametrize(
    "content",
    [
        b"", b"not gzip at all", gzip.compress(b"short"), _spz(3, 40), _spz(1 << 31, 0),
        _spz(1, 20, version=4), _spz(1, 20, degree=9), _spz(1, 20, bits=60), _spz(2, 40)[:-12],
    ],
    ids=["empty", "no gzip", "short", "cut", "huge", "version", "degree", "bits", "broken gzip"],
)  # fmt: skip
def test_strange_spz_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(BadData, match=r"a\.spz"):
        read_splats(tmp_path / "a.spz")


def test_spz_version_2_is_read(tmp_path: Path) -> None:
    """Rotation in three bytes: a quarter turn about z."""
    column = struct.pack("<9B", *[0] * 9) + bytes([255]) + bytes([128] * 3) + bytes([80] * 3)
    turn = bytes([128, 128, round(127.5 + 127.5 * np.sqrt(0.5))])
    head = struct.pack("<IIIBBBB", 0x5053474E, 2, 1, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + column + turn))
    cloud = read_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(cloud.quats[0], [0.7, 0, 0, 0.71], atol=0.02)
    np.testing.assert_allclose(cloud.scales[0], np.exp(-5), rtol=1e-6)


def test_strange_glb_is_refused(posed, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    write_splats(path, cloud_of(posed), posed.layers)
    whole = path.read_bytes()
    text = whole[20 : 20 + struct.unpack_from("<I", whole, 12)[0]]
    rest = whole[20 + len(text) :]

    def forged(content: object) -> bytes:
        words = json.dumps(content).encode()
        words += b" " * (-len(words) % 4)
        size = 20 + len(words) + len(rest)
        return struct.pack("<IIIII", 0x46546C67, 2, size, len(words), 0x4E4F534A) + words + rest

    def changed(*place: object, value: object) -> bytes:
        content = json.loads(text)
        inside = content
        for word in place[:-1]:
            inside = inside[word]
        inside[place[-1]] = value
        return forged(content)

    first = ("meshes", 0, "primitives", 0, "attributes")
    position = json.loads(text)["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    spoiled = [
        b"",
        b"glTF",
        whole[:-5],
        whole[:12] + bytes(8) + whole[20:],
        forged([]),
        forged({"meshes": 1}),
    ]
    spoiled += [changed("accessors", 0, "count", value=10**15), changed(*first, value=7)]
    spoiled += [changed("meshes", 0, value="none"), changed(*first, "POSITION", value="x")]
    spoiled.append(changed(*first, "KHR_gaussian_splatting:OPACITY", value=position))  # points, not shares
    for number, data in enumerate(spoiled):
        path.write_bytes(data)
        with pytest.raises(BadData, match=r"a\.glb"):
            read_splats(path)
            raise AssertionError(number)


def test_verify_looks_at_splat_files(posed, tmp_path: Path) -> None:
    cloud = cloud_of(posed)
    cloud = replace(cloud, opacities=cloud.opacities.copy())
    cloud.opacities[:3] = 0
    for kind in ("ply", "spz", "glb"):
        path = tmp_path / f"a.{kind}"
        write_splats(path, cloud, posed.layers)
        done = CliRunner().invoke(app, ["verify", str(path), "--json"])
        facts = json.loads(done.stdout.splitlines()[-1])["result"]
        assert done.exit_code == 0 and facts["gaussians"] == len(cloud) and facts["invisible"] == 3
        np.testing.assert_allclose(facts["high"], cloud.means.max(axis=0), atol=1e-4)
        path.write_bytes(path.read_bytes()[:-40])
        assert CliRunner().invoke(app, ["verify", str(path)]).exit_code == 65
    write_splats(tmp_path / "a.glb", cloud)
    glb = bytearray((tmp_path / "a.glb").read_bytes())
    start = 28 + struct.unpack_from("<I", glb, 12)[0]
    glb[start : start + 4] = struct.pack("<f", float("nan"))
    (tmp_path / "a.glb").write_bytes(glb)
    with pytest.raises(BadData, match="means of Gaussian 0"):
        splat_facts(tmp_path / "a.glb")


COMPRESSED_PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 3\n"
    b"property uint packed_position\nproperty uint packed_rotation\nend_header\n"
)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.ply", COMPRESSED_PLY + bytes(60), "compressed PLY"),
        ("b.ply", COMPRESSED_PLY.replace(b"chunk 1", b"chunk 9000"), "splat-transform"),
        ("a.spz", struct.pack("<II", 0x5053474E, 4) + bytes(60), "version 4"),
        ("b.spz", struct.pack("<II", 0x5053474E, 5), "version 5"),
        ("c.spz", _spz(1, 20, version=4), "version 4"),
        ("d.spz", _spz(1, 20, version=1), "version 1"),
    ],
)
def test_neighbouring_formats_are_named_with_their_cure(
    name: str, content: bytes, says: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadData) as caught:
        read_splats(tmp_path / name)
    assert says in caught.value.what + caught.value.fix and "Save it" in caught.value.fix
