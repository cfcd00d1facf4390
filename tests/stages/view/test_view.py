"""The viewer: what it answers, what it refuses, and what a real browser shows."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.errors import MissingInput, StorageFailure, UsageProblem
from stages.shared.outfit.foot_height import fix_foot_height
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.sources import parse_betas, read_bundles
from stages.view import stage
from stages.view.config import ViewConfig
from stages.view.server import Viewer
from stages.view.show import camera_of
from tests.browser import browser_page
from tests.listening import Listener
from tests.shared.outfit.wardrobe import motion

BAR = 40.0  # dB between the browser's pixels and our own renderer's
FREE = ViewConfig(port=0)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.square(one.astype(float) - other).mean(), 1e-9)))


@pytest.fixture(scope="module")
def viewer(wardrobe: Path) -> Iterator[Viewer]:
    with stage.open_viewer(
        [wardrobe / "body.gwg", wardrobe / "lower.gwg"], wardrobe, [wardrobe / "motion.npz"], FREE
    ) as made:
        thread = threading.Thread(target=made.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        yield made
        made.shutdown()
        thread.join(10)


def fetched(
    viewer: Viewer, path: str, method: str = "GET", body: Any = None, **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", viewer.server_address[1], timeout=30)
    text = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
    connection.request(method, path, text, headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), {name.lower(): value for name, value in answer.getheaders()}


def test_the_browser_shows_what_we_render(viewer: Viewer, wardrobe: Path) -> None:
    """Splats are drawn, swap and shape change the picture, the timeline moves, nothing complains."""

    def truth(tab: Any, names: tuple[str, ...], row: int, betas: str = "") -> np.ndarray:
        named = read_bundles([wardrobe / f"{name}.gwg" for name in names])
        worn = outfit_of_bundles(named, parse_betas(betas))
        composite = worn.composite(fix_foot_height(motion(), worn.body_model, worn.betas), row)
        return render_image(composite, camera_of(tab.run("camera()"))).on((1.0, 1.0, 1.0))

    with browser_page(720, 480) as tab:

        def shown() -> np.ndarray:
            """Of the screen, the part that no panel covers."""
            tab.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            return tab.screenshot()

        def settled() -> None:
            tab.wait_for("!asking && !waiting")

        free = (slice(0, 420), slice(0, 440))
        tab.open(viewer.url)
        tab.wait_for("gw.ready")
        settled()
        first = shown()
        wanted = truth(tab, ("body", "lower"), 0)
        assert psnr(first[free], wanted[free]) > BAR
        assert (wanted[free] < 200).any(axis=2).mean() > 0.01  # there is somebody
        assert psnr(first[free][:, ::-1], wanted[free]) < 30

        tab.run("const one = document.querySelector('[name=wear-upper]'); one.value = 'upper';"
                "one.dispatchEvent(new Event('change'))")  # fmt: skip
        tab.wait_for("gw.canvas.gaussians.layers.some((layer) => layer.name === 'upper')")
        settled()
        second = shown()
        assert psnr(second[free], truth(tab, ("body", "lower", "upper"), 0)[free]) > BAR
        assert psnr(second[free], first[free]) < 30  # the swap is seen

        tab.run("goTo(4)")
        settled()
        assert psnr(shown()[free], truth(tab, ("body", "lower", "upper"), 4)[free]) > BAR

        own = tab.run("[...document.querySelectorAll('#betas input')].map((one) => Number(one.value))")
        body = read_bundles([wardrobe / "body.gwg"])[0][1]
        np.testing.assert_allclose(own, body.arrays["betas"], atol=0.051)
        tab.run("const beta = document.querySelector('[name=beta-0]'); beta.value = 3;"
                "beta.dispatchEvent(new Event('input'))")  # fmt: skip
        tab.wait_for("gw.wish.betas.startsWith('3')")
        settled()
        third = shown()
        assert (
            psnr(third[free], truth(tab, ("body", "lower", "upper"), 4, tab.run("gw.wish.betas"))[free]) > BAR
        )

        tab.run("document.querySelector('[name=layer-lower]').click()")
        assert psnr(shown()[free], third[free]) < 40
        data = tab.run(
            "picture('#ffffff').then((blob) => blob.arrayBuffer()).then((data) => [...new Uint8Array(data)])"
        )
        saved = cv2.imdecode(np.array(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert saved.shape == (480, 720, 3) and psnr(shown()[free], saved[free]) > BAR
        before = tab.run("gw.drawn")
        tab.run("play(), 0")
        tab.wait_for(f"gw.drawn > {before} + 2")
        tab.run("stop()")
        settled()
        assert tab.run("byId('trouble').textContent") == "" and tab.complaints == []
        foreign = [
            address for address in tab.requests if not address.startswith((viewer.url, "data:", "blob:"))
        ]
        assert foreign == []


def test_what_is_answered(viewer: Viewer) -> None:
    status, body, headers = fetched(viewer, "/show")
    show = json.loads(body)
    assert status == 200 and sorted(piece["name"] for piece in show["pieces"]) == ["body", "lower", "upper"]
    assert show["wear"] == ["body", "lower"]
    assert [entry["frames"] for entry in show["motions"]] == [5, 1] and show["motions"][0]["fps"] == 30
    assert (
        "default-src 'none'" in headers["content-security-policy"] and headers["cache-control"] == "no-store"
    )
    assert fetched(viewer, "/gaussians?wear=body&row=2")[1][:4] == b"GSWS"
    camera = {"width": 40, "height": 30, "intrinsics": [60, 60, 20, 15]}
    camera["cameraFromWorld"] = [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 2, 0, 0, 0, 1]  # type: ignore[assignment]
    wish = {"wear": ["body", "upper"], "row": 1, "camera": camera, "background": "transparent"}
    status, body, headers = fetched(viewer, "/picture", "POST", wish)
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (
        status == 200
        and picture.shape == (30, 40, 4)
        and picture[0, 0, 3] == 0
        and picture[..., 3].max() > 250
    )


def test_what_is_refused(viewer: Viewer) -> None:
    camera = {"width": 40, "height": 30, "intrinsics": [60, 60, 20, 15], "cameraFromWorld": [0] * 16}
    for method, path, body in (
        ("GET", "/gaussians?wear=../../etc/passwd", None),
        ("GET", "/gaussians?wear=lower", None),
        ("GET", "/gaussians?wear=body&row=99", None),
        ("GET", "/gaussians?wear=body&row=-1", None),
        ("GET", "/gaussians?wear=body&row=x", None),
        ("GET", "/gaussians?wear=body&motion=7", None),
        ("GET", "/gaussians?wear=body&betas=1e9", None),
        ("POST", "/picture", b"{nonsense"),
        ("POST", "/picture", [1, 2]),
        ("POST", "/picture", {"wear": ["body"]}),
        ("POST", "/picture", {"wear": ["body"], "camera": camera}),
        ("POST", "/picture", {"wear": ["body"], "camera": {**camera, "width": 10**9}}),
        ("POST", "/picture", {"wear": ["body"], "camera": camera, "background": "/etc/wall.png"}),
    ):
        status, answer, _ = fetched(viewer, path, method, body)
        assert status == 400 and json.loads(answer)["error"], (path, body)
    for path in ("/../../etc/passwd", "/view.js", "/picture", "/stages"):
        assert fetched(viewer, path)[0] == 404, path
    assert fetched(viewer, "/picture", "POST", b"x" * 70_000)[0] == 413
    assert fetched(viewer, "/show", Host="evil.example")[0] == 403  # a foreign name that points here
    assert fetched(viewer, "/show")[0] == 200  # still there


def test_beyond_this_machine_a_token_is_asked_for(wardrobe: Path) -> None:
    tokens = set()
    for _ in range(2):
        with stage.open_viewer([wardrobe / "body.gwg"], config=ViewConfig("0.0.0.0", 0)) as made:
            thread = threading.Thread(target=made.serve_forever, args=(0.05,), daemon=True)
            thread.start()
            tokens.add(made.token)
            assert len(made.token) >= 24 and made.url.endswith(f"?token={made.token}")
            assert fetched(made, "/")[0] == 403 and fetched(made, "/show")[0] == 403
            assert fetched(made, "/?token=wrong")[0] == 403
            assert fetched(made, f"/?token={made.token}")[0] == 200
            assert fetched(made, "/show", **{"X-Token": made.token})[0] == 200
            made.shutdown()
            thread.join(10)
    assert len(tokens) == 2
    with stage.open_viewer([wardrobe / "body.gwg"], config=FREE) as made:
        assert made.token == "" and made.server_address[0] == "127.0.0.1"


def test_what_is_on_the_shelf(dressed_subject: Path, wardrobe: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.gwg").write_bytes((wardrobe / "upper.gwg").read_bytes()[:-1])
    (tmp_path / "body.gwg").write_bytes((wardrobe / "body.gwg").read_bytes())
    heard = Listener()
    with stage.open_viewer([], tmp_path, [], FREE, heard) as made:
        assert [piece["name"] for piece in made.show.shelf.described()] == ["body"]
        assert made.show.shelf.worn == ("body",)
    assert len(heard.warnings) == 1 and "broken.gwg" in heard.warnings[0]
    with stage.open_viewer([dressed_subject], config=FREE) as made:
        content = made.show.described("")
        assert content["pieces"] == [] and [m["frames"] for m in content["motions"]] == [5, 1]
    for sources, folder, error in (
        ([dressed_subject, wardrobe / "body.gwg"], None, UsageProblem),
        ([wardrobe / "upper.gwg"], None, UsageProblem),
        ([wardrobe / "none.gwg"], None, MissingInput),
        ([wardrobe / "body.gwg"], tmp_path / "nowhere", MissingInput),
    ):
        with pytest.raises(error):
            stage.open_viewer(sources, folder, [], FREE)


def test_command(viewer: Viewer, wardrobe: Path) -> None:
    words = ["view", str(wardrobe / "body.gwg"), "--poses", str(wardrobe / "motion.npz"), "--json"]
    plan = CliRunner().invoke(app, [*words, "--dry-run"])
    assert json.loads(plan.stdout.splitlines()[-1])["result"]["outputs"] == []
    taken = CliRunner().invoke(app, [*words, "--port", str(viewer.server_address[1])])
    assert taken.exit_code == 74 and "port" in taken.stderr
    with pytest.raises(StorageFailure):
        stage.open_viewer([wardrobe / "body.gwg"], config=ViewConfig(port=viewer.server_address[1]))
    assert "--wardrobe" in CliRunner().invoke(app, ["view", "--help"]).stdout
