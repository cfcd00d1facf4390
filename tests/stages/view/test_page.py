"""The page in a real browser: keyboard, address, dropped files, phones, and accessibility."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.shared.artifacts.bundle import read_bundle, write_bundle
from stages.view.server import Viewer
from tests.browser import browser_page

READY = "gw.ready && !asking && !waiting && !sorting"


def _axe() -> str:
    """The script of axe-core in the folder `NODE_MODULES` or among npm's global packages, or a skip."""
    modules, npm = os.environ.get("NODE_MODULES", ""), shutil.which("npm")
    if not modules and npm:
        modules = subprocess.run(
            [npm, "root", "-g"], capture_output=True, text=True, timeout=60
        ).stdout.strip()
    path = Path(modules) / "axe-core" / "axe.min.js"
    if not path.is_file():
        pytest.skip("no axe-core on this machine: npm install -g axe-core")
    return path.read_text()


def _box(tab: Any, name: str) -> dict[str, float]:
    return dict(tab.run(f"byId('{name}').getBoundingClientRect().toJSON()"))


def test_keys_turn_and_step_and_the_address_keeps_it(viewer: Viewer) -> None:
    with browser_page(720, 480) as tab:
        tab.open(viewer.url)
        tab.wait_for(READY)
        first = tab.run("gw.orbit.azimuth")
        tab.press("ArrowRight")
        assert tab.run("gw.orbit.azimuth") < first - 0.05
        tab.press(".")
        tab.wait_for(f"gw.request.row === 1 && {READY}")
        tab.run("document.querySelector('[name=wear-upper][value=upper]').click()")
        tab.run("document.querySelector('[name=layer-body]').click()")
        tab.wait_for("['upper', 'row=1', 'hidden=body'].every((part) => location.hash.includes(part))")
        address, azimuth = tab.run("location.href"), tab.run("gw.orbit.azimuth")
        assert tab.complaints == []
    with browser_page(720, 480) as tab:
        tab.open(address)
        tab.wait_for(READY)
        assert tab.run("gw.request.row") == 1 and "upper" in tab.run("gw.request.wear")
        assert tab.run("[...gw.canvas.hidden]") == ["body"]
        assert abs(tab.run("gw.orbit.azimuth") - azimuth) < 2e-3
        assert tab.run("document.querySelector('[name=wear-upper]:checked').value") == "upper"


def test_garments_have_pictures(viewer: Viewer) -> None:
    with browser_page(720, 480) as tab:
        tab.open(viewer.url)
        tab.wait_for(READY)
        images = "[...document.querySelectorAll('.tile img')]"
        tab.wait_for(f"{images}.length === 3 && {images}.every((image) => image.naturalWidth > 1)")


def test_a_dropped_bundle_is_worn(viewer: Viewer, wardrobe: Path, tmp_path: Path) -> None:
    coat = read_bundle(wardrobe / "upper.gwg")
    write_bundle(tmp_path / "red.gwg", replace(coat, manifest={**coat.manifest, "note": "red"}))
    data = base64.b64encode((tmp_path / "red.gwg").read_bytes()).decode()
    with browser_page(720, 480) as tab:
        tab.open(viewer.url)
        tab.wait_for(READY)
        tab.run(
            f"const data = Uint8Array.from(atob('{data}'), (c) => c.charCodeAt(0));"
            "const dropped = new DataTransfer(); dropped.items.add(new File([data], 'red.gwg'));"
            "dispatchEvent(new DragEvent('drop', { dataTransfer: dropped, cancelable: true }))"
        )
        tab.wait_for("gw.request.wear.includes('red') && gw.canvas.gaussians.layers.length === 3")
        assert tab.run("document.querySelector('[name=wear-upper]:checked').value") == "red"
        assert tab.run("byId('trouble').textContent") == "" and tab.complaints == []
    del viewer.session.catalog.items["red"]


def test_on_a_phone_the_settings_are_a_sheet_below_the_person(viewer: Viewer) -> None:
    with browser_page(390, 844, phone=True) as tab:
        tab.open(viewer.url)
        tab.wait_for(READY)
        assert not _box(tab, "side")["height"] and _box(tab, "bar")["width"] == 390

        def rows() -> np.ndarray:
            """Rows of the screen that show the person."""
            tab.wait_for(READY)
            tab.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            return np.flatnonzero((tab.screenshot()[:, 20:370] < 200).any(axis=(1, 2)))

        free = _box(tab, "bar")["top"]
        assert rows()[rows() < free - 2].max() < free - 10
        tab.run("byId('sheet').click()")
        side = _box(tab, "side")
        assert side["width"] == 390 and side["top"] > 300 and side["bottom"] <= free + 1
        assert tab.run("byId('sheet').getAttribute('aria-expanded')") == "true"
        above = rows()[rows() < side["top"] - 2]
        assert above.min() > 0 and above.max() < side["top"] - 5
        assert "One finger" in tab.run("byId('hint').innerText") and "wheel" not in tab.run(
            "byId('hint').innerText"
        )
        assert tab.complaints == []


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
def test_axe_finds_nothing(size: tuple[int, int], viewer: Viewer) -> None:
    script = _axe()
    with browser_page(*size, phone=size[0] < 640) as tab:
        tab.open(viewer.url)
        tab.wait_for(READY)
        if size[0] < 640:
            tab.run("byId('sheet').click()")
        found = tab.run(script + ";axe.run().then(({ violations }) => JSON.stringify(violations))")
        assert [(one["id"], one["impact"]) for one in json.loads(found)] == []


def test_a_tab_that_closes_while_it_plays_is_not_an_error(
    viewer: Viewer, capfd: pytest.CaptureFixture[str]
) -> None:
    with browser_page(400, 300) as tab:
        tab.open(viewer.url)
        tab.wait_for(READY)
        drawn = tab.run("play(), gw.drawn")
        tab.wait_for(f"gw.drawn > {drawn} + 1")
    for _ in range(4):  # all streams are free again
        assert viewer.streams.acquire(timeout=20)
    for _ in range(4):
        viewer.streams.release()
    assert "Traceback" not in "".join(capfd.readouterr())
