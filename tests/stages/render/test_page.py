"""The page from disk: one file, nothing fetched, and pixels as our own renderer makes them."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.render import page
from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.outfit.render_image import render_image
from stages.shared.render_sequence.config import RenderConfig
from tests.browser import browser_page
from tests.shared.outfit.wardrobe import cameras, motion, outfit

BAR = 45.0  # dB, over the whole picture


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.square(one.astype(float) - other).mean(), 1e-9)))


def in_javascript(camera: Camera) -> str:
    """The camera as viewer.js takes it."""
    k = camera.intrinsics
    content = {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": [k[0, 0], k[1, 1], k[0, 2], k[1, 2]],
        "cameraFromWorld": camera.camera_from_world.reshape(-1).tolist(),
    }
    return json.dumps(content)


def decoded(address: str) -> np.ndarray:
    """(H, W, 3) u8 of a data URL."""
    data = base64.b64decode(address.partition(",")[2])
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


@pytest.fixture(scope="module")
def turntable(wardrobe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "page.html"
    bundles = [wardrobe / f"{name}.gwg" for name in ("body", "lower", "upper")]
    page.run(bundles, wardrobe / "motion.npz", None, path, RenderConfig(frames="3:4", betas="0"))
    return path


def test_one_file_that_names_no_address(turntable: Path) -> None:
    text = turntable.read_text()
    assert not re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}/", text)
    assert "default-src 'none'" in text and "@" not in re.sub(r"@media", "", text.split("<script")[0])
    assert [path.name for path in turntable.parent.iterdir()] == ["page.html"]


def test_looks_like_the_render(turntable: Path) -> None:
    composite = outfit("body", "lower", "upper").composite(motion(), 3)
    with browser_page(200, 160) as tab:
        tab.open(turntable.as_uri())
        tab.wait_for("gw.ready")
        assert tab.run("gw.canvas.halfFloat")
        for camera in cameras():
            found = tab.run(f"gw.canvas.draw({in_javascript(camera)}), byId('canvas').toDataURL()")
            truth = render_image(composite, camera).on((1.0, 1.0, 1.0))
            assert psnr(decoded(found), truth) > BAR
            assert psnr(decoded(found)[:, ::-1], truth) < 25
        tab.run("gw.redraw()")
        before = tab.screenshot()
        tab.run("document.querySelector('input[name=upper]').click()")
        tab.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        bare = render_image(outfit("body", "lower").composite(motion(), 3), cameras()[0]).on((1.0, 1.0, 1.0))
        found = tab.run(f"gw.canvas.draw({in_javascript(cameras()[0])}), byId('canvas').toDataURL()")
        assert psnr(decoded(found), bare) > BAR  # a layer is off
        assert psnr(before, tab.screenshot()) < 40
        assert tab.complaints == []
        assert [address for address in tab.requests if not address.startswith(("file:", "data:"))] == []


def test_dragging_turns_the_camera(turntable: Path) -> None:
    with browser_page(200, 160) as tab:
        tab.open(turntable.as_uri())
        tab.wait_for("gw.ready")
        start = tab.run("gw.orbit.camera(200, 160).cameraFromWorld")
        distance = tab.run("gw.orbit.distance")
        tab.run("gw.orbit.turn(100, 20), gw.orbit.approach(0.5)")
        turned = tab.run("gw.orbit.camera(200, 160).cameraFromWorld")
        target = np.array([*tab.run("gw.orbit.target"), 1])
        rotation = np.array(turned).reshape(4, 4)[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1)
        seen = np.array(turned).reshape(4, 4) @ target
        np.testing.assert_allclose(seen[:3], [0, 0, distance / 2], atol=1e-6)
        assert np.abs(np.array(start) - turned).max() > 0.3
        tab.run("gw.orbit.reset()")
        assert tab.run("gw.orbit.camera(200, 160).cameraFromWorld") == start


def test_command(wardrobe: Path, tmp_path: Path) -> None:
    words = ["render", str(wardrobe / "body.gwg"), "--poses", "canonical", "--html", str(tmp_path / "a.html")]
    plan = CliRunner().invoke(app, [*words, "--dry-run", "--json"])
    assert json.loads(plan.stdout.splitlines()[-1])["result"]["outputs"] == [str(tmp_path / "a.html")]
    assert not list(tmp_path.iterdir())
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])["result"]
    assert result["layers"] == ["body"] and result["bytes"] == (tmp_path / "a.html").stat().st_size
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]
    with pytest.raises(UsageProblem, match="folder"):
        page.run([wardrobe / "body.gwg"], Path("canonical"), None, tmp_path)
