"""Bytes for the browser come back as the Gaussians they were, and what the pages need is in the package."""

from __future__ import annotations

import fnmatch
import json
import struct
import tomllib
from pathlib import Path

import numpy as np

from stages.shared.outfit.viewpoints import look_at_camera
from stages.shared.web.pack import pack_gaussians
from stages.shared.web.start import orbit_start, viewer_script
from tests.shared.outfit.wardrobe import motion, outfit

REPOSITORY = Path(__file__).resolve().parents[3]


def unpacked(data: bytes) -> tuple[dict, list[np.ndarray]]:
    """As viewer.js reads it."""
    magic, length = struct.unpack_from("<II", data)
    assert magic == 0x32575347
    info, at = json.loads(data[8 : 8 + length]), 8 + length + -length % 4
    columns = []
    for kind, width in (("<u2", 3), ("<f2", 6), ("u1", 4)):
        values = np.frombuffer(data, kind, info["count"] * width, at).reshape(-1, width)
        columns.append(values.astype(float))
        at += values.nbytes + -values.nbytes % 4
    assert at == len(data)
    return info, columns


def test_packed_gaussians_keep_their_place_form_and_colour() -> None:
    composite = outfit("body", "upper").composite(motion(), 4)
    info, (places, covariances, tints) = unpacked(pack_gaussians(composite, row=4))
    assert info["row"] == 4
    low, high = np.array(info["places"]).T
    means = low + places * (high - low) / 65535
    np.testing.assert_allclose(means, composite.means.numpy(), atol=1e-5)
    upper = composite.covariances.numpy()[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    largest = np.abs(upper).max(axis=1, keepdims=True)
    assert (np.abs(info["unit"] * covariances - upper) / largest).max() < 2**-10
    np.testing.assert_allclose(tints[:, :3] / 255, composite.features[:, :3].numpy(), atol=0.5001 / 255)
    np.testing.assert_allclose(tints[:, 3] / 255, composite.opacities.numpy(), atol=0.5001 / 255)
    counts = [int((composite.layer_ids == index).sum()) for index in (0, 1)]
    assert [(layer["name"], layer["start"], layer["count"]) for layer in info["layers"]] == [
        ("body", 0, counts[0]),
        ("upper", counts[0], counts[1]),
    ]


def test_the_first_camera_is_the_given_one() -> None:
    composite = outfit("body").composite(motion(), 0)
    camera = look_at_camera("a", np.array([0.2, 0.1, -0.1]), 0.7, (0.4, 0.5, 0.3), (120, 160))
    start = orbit_start(camera, composite)
    away = np.array([np.sin(start["azimuth"]), 0, np.cos(start["azimuth"])]) * np.cos(start["tilt"])
    away[1] = np.sin(start["tilt"])
    eye = np.array(start["target"]) + start["distance"] * away
    np.testing.assert_allclose(eye, camera.centre, atol=1e-4)
    assert abs(start["fieldOfView"] - 30) < 1e-4


def test_every_file_beside_the_code_is_packaged() -> None:
    """A wheel without viewer.js would only fail at a user's."""
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    data = settings["tool"]["setuptools"]["package-data"]
    for path in (REPOSITORY / "stages").rglob("*"):
        if path.suffix in (".js", ".html", ".css", ".json", ".safetensors"):
            package = ".".join(path.relative_to(REPOSITORY).parent.parts)
            inside = [
                (name, path.relative_to(REPOSITORY / name.replace(".", "/")))
                for name in data
                if package == name or package.startswith(name + ".")
            ]
            assert any(fnmatch.fnmatch(str(file), glob) for name, file in inside for glob in data[name]), path
    assert "class SplatCanvas" in viewer_script()
