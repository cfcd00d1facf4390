"""The page that plays a motion: frames as our own renderer makes them, size, timeline, keyboard."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.render import page
from stages.render.clip import LARGEST_PAGE, _four_weights, affordable_keys, key_frames
from stages.shared.errors import UsageProblem
from stages.shared.outfit.render_image import render_image
from stages.shared.render_sequence.config import RenderConfig
from tests.browser import browser_page
from tests.shared.outfit.wardrobe import cameras, motion, outfit
from tests.stages.render.test_page import decoded, in_javascript, psnr

BAR = 38.0  # dB, over the whole picture: colours are means over the key frames


@pytest.fixture(scope="module")
def clip(wardrobe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "clip.html"
    bundles = [wardrobe / f"{name}.gwg" for name in ("body", "lower", "upper")]
    result = page.run(bundles, wardrobe / "motion.npz", None, path, RenderConfig(betas="0"))
    assert result["frames"] == 5 and result["bytes"] == path.stat().st_size
    return path


def test_every_frame_looks_like_the_render(clip: Path) -> None:
    worn = outfit("body", "lower", "upper")
    with browser_page(400, 320) as tab:
        tab.open(clip.as_uri())
        tab.wait_for("gw.ready")
        for frame in range(5):
            tab.run(f"gw.goTo({frame})")
            for camera in cameras()[:2]:
                picture = tab.run(f"gw.canvas.draw({in_javascript(camera)}), byId('canvas').toDataURL()")
                truth = render_image(worn.composite(motion(), frame), camera).on((1.0, 1.0, 1.0))
                assert psnr(decoded(picture), truth) > BAR, frame
        other = render_image(worn.composite(motion(), 0), cameras()[0]).on((1.0, 1.0, 1.0))
        last = tab.run(f"gw.canvas.draw({in_javascript(cameras()[0])}), byId('canvas').toDataURL()")
        assert psnr(decoded(last), other) < 30  # it moves
        assert tab.complaints == [] and set(tab.requests) <= {clip.as_uri(), "data:,"}


def test_it_plays_and_obeys_keys_and_timeline(clip: Path) -> None:
    def press(key: str, code: str = "") -> None:
        tab.run(f"document.body.dispatchEvent(new KeyboardEvent('keydown', "
                f"{{key: '{key}', code: '{code}', bubbles: true}}))")  # fmt: skip

    with browser_page(390, 844) as tab:
        tab.open(clip.as_uri())
        tab.wait_for("gw.ready")
        press(" ", "Space")
        assert tab.run("gw.playing") is True
        tab.wait_for("gw.times.length > 2")
        press(" ", "Space")
        assert tab.run("gw.playing") is False
        tab.run("gw.goTo(1)")
        press(".")
        assert tab.run("[gw.frame, byId('row').value]") == [2, "2"]
        press(",")
        press(",")
        press(",")
        assert tab.run("gw.frame") == 4
        before = tab.run("gw.orbit.azimuth")
        press("ArrowLeft")
        assert tab.run("gw.orbit.azimuth") != before
        tab.run("const row = byId('row'); row.value = 3; row.dispatchEvent(new Event('input'))")
        assert tab.run("gw.frame") == 3 and "0.1 s" in tab.run("byId('time').textContent")
        unnamed = "[...document.querySelectorAll('input,button')].filter((one) => !one.labels?.length"
        assert tab.run(unnamed + " && !one.ariaLabel && !one.textContent).length") == 0


@pytest.mark.parametrize(("frames", "gaussians"), [(150, 30_000), (600, 1000), (3000, 10_000), (2, 120_000)])
def test_key_frames_keep_the_page_small(frames: int, gaussians: int) -> None:
    keys = affordable_keys(frames, gaussians)
    size = (30 * gaussians + 2640 * frames + 3 * gaussians * keys) / 0.75
    assert size < LARGEST_PAGE or keys == 2
    if (frames, gaussians) == (150, 30_000):
        assert keys > 60


def test_key_frames_are_where_the_motion_needs_them() -> None:
    places = np.zeros((40, 10, 3), np.float32)
    assert key_frames(places[:1], 9) == [0] and key_frames(places, 9) == [0, 39]
    places[:, :, 0] = np.linspace(0, 1, 40)[:, None]
    assert key_frames(places, 9) == [0, 39]  # what is linear needs no more
    places[17:, :, 1] = 0.07  # a jump from one frame to the next
    assert key_frames(places, 9) == [0, 16, 17, 39]
    places[:, :, 2] = np.sin(np.linspace(0, 20, 40))[:, None]
    keys = key_frames(places, 12)
    assert len(keys) == 12 and keys == sorted(set(keys)) and (keys[0], keys[-1]) == (0, 39)
    assert key_frames(places, 99) == list(range(40))


def test_weights_are_rounded_without_losing_any() -> None:
    random = np.random.default_rng(0)
    weights = random.dirichlet(np.full(55, 0.05), 500)
    joints, steps = _four_weights(weights)
    assert (steps.sum(axis=1) == 255).all() and steps.min() >= 0
    kept = np.take_along_axis(weights, joints, axis=1)
    np.testing.assert_allclose(steps / 255, kept / kept.sum(axis=1, keepdims=True), atol=2.1 / 255)


def test_too_many_frames_are_refused(wardrobe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.render.clip.MOST_FRAMES", 4)
    with pytest.raises(UsageProblem, match="at most 4"):
        page.run([wardrobe / "body.gwg"], wardrobe / "motion.npz", None, tmp_path / "a.html", RenderConfig())
    assert not (tmp_path / "a.html").exists()
