"""The viewer: what it answers, what it refuses, and what a real browser shows."""

from __future__ import annotations

import http.client
import json
import socket
import struct
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.errors import MissingInput, StorageFailure, UsageProblem
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.retarget import fix_foot_height
from stages.shared.outfit.sources import parse_betas, read_bundles
from stages.view import stage
from stages.view.config import ViewConfig
from stages.view.server import MOST_STREAMS, Viewer
from stages.view.session import camera_of
from tests.browser import browser_page
from tests.listening import Listener
from tests.shared.outfit.wardrobe import motion

BAR = 40.0  # dB between the browser's pixels and our own renderer's
FREE = ViewConfig(port=0)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.square(one.astype(float) - other).mean(), 1e-9)))


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
            tab.wait_for("!asking && !waiting && !sorting")

        free = (slice(0, 420), slice(0, 440))
        tab.open(viewer.url)
        tab.wait_for("gw.ready")
        settled()
        first = shown()
        wanted = truth(tab, ("body", "lower"), 0)
        assert psnr(first[free], wanted[free]) > BAR
        assert (wanted[free] < 200).any(axis=2).mean() > 0.01  # there is somebody
        assert psnr(first[free][:, ::-1], wanted[free]) < 30

        tab.run("document.querySelector('[name=wear-upper][value=upper]').click()")
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
        tab.wait_for("gw.request.betas.startsWith('3')")
        settled()
        third = shown()
        assert (
            psnr(third[free], truth(tab, ("body", "lower", "upper"), 4, tab.run("gw.request.betas"))[free])
            > BAR
        )

        tab.run("document.querySelector('[name=layer-lower]').click()")
        settled()
        assert psnr(shown()[free], third[free]) < 40
        data = tab.run(
            "picture('#ffffff').then((blob) => blob.arrayBuffer()).then((data) => [...new Uint8Array(data)])"
        )
        saved = cv2.imdecode(np.array(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        # Only the picture has the penetration pass, which changes the thin upper layer a little.
        assert saved.shape == (480, 720, 3) and psnr(shown()[free], saved[free]) > 34
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
    assert fetched(viewer, "/gaussians?wear=body&row=2")[1][:4] == b"GSW2"
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


STRANGE: list[tuple[str, str, Any, dict[str, str]]] = [
    ("POST", "/picture", b'{"wear": ["body"], "row": 1e400}', {}),
    ("POST", "/picture", b'{"wear": ["body"], "motion": -1e999}', {}),
    ("POST", "/picture", {"wear": 5}, {}),
    ("POST", "/picture", {"wear": None}, {}),
    ("POST", "/picture", {"wear": [["body"]]}, {}),
    ("POST", "/picture", {"wear": ["body"], "camera": 3}, {}),
    ("POST", "/picture", {"wear": ["body"], "camera": {"intrinsics": [10**4000] * 4}}, {}),
    ("POST", "/picture", b"[" * 60_000, {}),
    ("POST", "/picture", b"\xff\xfe", {}),
    ("POST", "/picture", b"", {"Content-Length": "9" * 4901}),
    ("POST", "/picture", b"", {"Content-Length": "-1"}),
    ("POST", "/picture", b"", {"Content-Length": "\u0663"}),
    ("POST", "/bundle?name=../../x", b"no bundle", {}),
    ("POST", "/bundle", b"", {}),
    ("GET", "http://[", None, {}),
    ("GET", "//[::1", None, {}),
    ("GET", "/gaussians?row=" + "9" * 5000, None, {}),
    ("GET", "/gaussians?" + "&".join(f"a{i}=1" for i in range(99)), None, {}),
    ("GET", "/stream?wear=body&row=99", None, {}),
    ("GET", "/body?wear=upper", None, {}),
    ("GET", "/preview?name=../x", None, {}),
]


@pytest.mark.parametrize("case", range(len(STRANGE)))
def test_every_request_is_answered_with_a_status(
    case: int, viewer: Viewer, capfd: pytest.CaptureFixture[str]
) -> None:
    method, path, body, headers = STRANGE[case]
    text = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
    length = {} if text is None or "Content-Length" in headers else {"Content-Length": str(len(text))}
    lines = [f"{method} {path} HTTP/1.1", f"Host: 127.0.0.1:{viewer.server_address[1]}"]
    lines += [f"{name}: {value}" for name, value in {**headers, **length}.items()]
    with socket.create_connection(("127.0.0.1", viewer.server_address[1]), 20) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode() + (text or b""))
        answer = connection.recv(1 << 16)
    assert answer.startswith(b"HTTP/1.1 4"), answer[:200]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"Host": "evil.example"},
    ],
)
def test_another_origin_is_refused_before_anything_is_rendered(
    headers: dict[str, str], viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer.session, "picture", lambda *given: pytest.fail("rendered"))
    monkeypatch.setattr(viewer.session, "gaussians", lambda *given: pytest.fail("posed"))
    camera = {"width": 40, "height": 30, "intrinsics": [60, 60, 20, 15], "cameraFromWorld": [0] * 16}
    assert fetched(viewer, "/picture", "POST", {"wear": ["body"], "camera": camera}, **headers)[0] == 403
    assert fetched(viewer, "/gaussians?wear=body", **headers)[0] == 403
    assert fetched(viewer, "http://evil.example/show")[0] == 403
    own = f"http://127.0.0.1:{viewer.server_address[1]}"
    assert fetched(viewer, "/show", Origin=own, **{"Sec-Fetch-Site": "same-origin"})[0] == 200


@pytest.mark.parametrize(("width", "height"), [(4097, 10), (10, 5000), (4096, 4096)])
def test_pictures_are_bounded_by_what_a_page_can_show(width: int, height: int, viewer: Viewer) -> None:
    matrix = [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 2, 0, 0, 0, 1]
    camera = {"width": width, "height": height, "intrinsics": [60, 60, 20, 15], "cameraFromWorld": matrix}
    status, answer, _ = fetched(viewer, "/picture", "POST", {"wear": ["body"], "camera": camera})
    assert status == 400 and "too large" in json.loads(answer)["error"]


def test_frames_are_streamed_until_the_page_leaves(viewer: Viewer, capfd: pytest.CaptureFixture[str]) -> None:
    """One connection brings frame after frame; those that are closed leave room for others."""
    for _ in range(6):
        connection = http.client.HTTPConnection("127.0.0.1", viewer.server_address[1], timeout=30)
        connection.request("GET", "/stream?wear=body,upper&row=3")
        answer, rows = connection.getresponse(), []
        for _ in range(4):
            (length,) = struct.unpack("<I", answer.read(4))
            frame = answer.read(length)
            text = struct.unpack_from("<I", frame, 4)[0]
            info = json.loads(frame[8 : 8 + text])
            rows.append((info["row"], info["place"]))
        assert rows[0] == (3, 0) and all(row == (3 + place) % 5 for row, place in rows)
        assert [place for _, place in rows] == sorted({place for _, place in rows})
        answer.close()
        connection.close()
        deadline = time.monotonic() + 10
        while not viewer.streams.acquire(blocking=False):
            assert time.monotonic() < deadline
        viewer.streams.release()
    assert capfd.readouterr() == ("", "")


def test_too_many_streams_are_turned_away(viewer: Viewer) -> None:
    for _ in range(MOST_STREAMS):  # a stream of an earlier test may still be closing
        assert viewer.streams.acquire(timeout=20)
    try:
        assert fetched(viewer, "/stream?wear=body")[0] == 503
    finally:
        for _ in range(MOST_STREAMS):
            viewer.streams.release()


def test_the_viewer_listens_on_ipv6(wardrobe: Path) -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 on this machine")
    with stage.open_viewer([wardrobe / "body.gwg"], config=ViewConfig("::1", 0)) as made:
        thread = threading.Thread(target=made.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        assert made.url == f"http://[::1]:{made.server_address[1]}/" and not made.token
        connection = http.client.HTTPConnection("::1", made.server_address[1], timeout=30)
        connection.request("GET", "/show")
        assert connection.getresponse().status == 200
        made.shutdown()
        thread.join(10)


def test_height_and_girth_follow_the_shape(viewer: Viewer) -> None:
    def body(betas: str) -> dict[str, Any]:
        return dict(json.loads(fetched(viewer, f"/body?wear=body&betas={betas}")[1]))

    usual, taller, wider = body("0"), body("3"), body("0,3")
    assert 140 < usual["height_cm"] < 200 and 50 < usual["girth_cm"] < 130
    assert taller["height_cm"] > usual["height_cm"] + 5
    assert abs(wider["girth_cm"] - usual["girth_cm"]) > 3
    assert len(usual["betas"]) == 10 and usual["betas"] == wider["betas"]


def test_bundles_can_be_brought_by_the_page(viewer: Viewer, wardrobe: Path, tmp_path: Path) -> None:
    from dataclasses import replace

    from stages.shared.artifacts.bundle import read_bundle, write_bundle

    coat = read_bundle(wardrobe / "upper.gwg")
    write_bundle(tmp_path / "red.gwg", replace(coat, manifest={**coat.manifest, "note": "red"}))
    data = (tmp_path / "red.gwg").read_bytes()
    status, answer, _ = fetched(viewer, "/bundle?name=red.gwg", "POST", data)
    added = json.loads(answer)
    assert status == 200 and added["name"] == "red" and "red" in [one["name"] for one in added["pieces"]]
    assert fetched(viewer, "/gaussians?wear=body,red")[0] == 200
    assert fetched(viewer, "/preview?name=red")[1][:4] == b"\x89PNG"
    assert json.loads(fetched(viewer, "/bundle?name=again.gwg", "POST", data)[1])["name"] == "red"
    assert fetched(viewer, "/bundle?name=bad.gwg", "POST", data[:-1])[0] == 400
    assert not list(wardrobe.glob("red*"))
    del viewer.session.catalog.items["red"]


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


def test_what_is_in_the_catalogue(dressed_subject: Path, wardrobe: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.gwg").write_bytes((wardrobe / "upper.gwg").read_bytes()[:-1])
    (tmp_path / "body.gwg").write_bytes((wardrobe / "body.gwg").read_bytes())
    heard = Listener()
    with stage.open_viewer([], tmp_path, [], FREE, heard) as made:
        assert [piece["name"] for piece in made.session.catalog.described()] == ["body"]
        assert made.session.catalog.worn == ("body",)
    assert len(heard.warnings) == 1 and "broken.gwg" in heard.warnings[0]
    with stage.open_viewer([dressed_subject], config=FREE) as made:
        content = made.session.described("")
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
