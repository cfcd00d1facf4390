"""How fast the page of `gw view` plays, as the page counts, and what server and drawing allow."""

from __future__ import annotations

import threading
import time
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli.console import Console
from gw_cli.inputs import check_bundles, check_poses
from gw_cli.options import Json
from stages.view.config import ViewConfig
from stages.view.server import Viewer
from stages.view.session import FrameRequest
from stages.view.stage import open_viewer
from tests.benchmarks.command import application
from tests.browser import Page, browser_page

# Reading a pixel waits until everything is drawn.
_DRAWING = """(() => {
  const gl = gw.canvas.gl, pixel = new Uint8Array(4), started = performance.now();
  for (let i = 0; i < COUNT; i++) {
    gw.canvas.draw(camera());
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  }
  return (1000 * COUNT) / (performance.now() - started);
})()"""
_RENDERER = """(() => {
  const gl = gw.canvas.gl, named = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
})()"""


def viewer(
    bundles: Annotated[list[Path], typer.Argument(metavar="BODY.gwg GARMENT.gwg …", help="The outfit.")],
    poses: Annotated[Path, typer.Option(help="The motion.")],
    seconds: Annotated[float, typer.Option(min=2, help="How long the page plays.")] = 10.0,
    width: Annotated[int, typer.Option(min=64, help="Pixels of the window.")] = 960,
    height: Annotated[int, typer.Option(min=64, help="Pixels of the window.")] = 720,
    as_json: Json = False,
) -> None:
    """Play a motion in a headless Chromium and print the frames per second of page, server and drawing.

    The page counts frames that it has shown over its last two seconds. A page that draws too slowly lowers
    its resolution (page_detail, 1 is the screen's). The server alone makes frames for
    nobody; drawing alone shows one frame again and again. Without a graphics card the browser draws on the
    cores that the server needs.
    """
    console = Console(as_json)
    check_bundles(bundles)
    check_poses([poses])
    console.loading()
    with open_viewer(bundles, None, [poses], ViewConfig(port=0), console) as served:
        wear = tuple(served.session.catalog.worn)
        console.step("making frames without a browser")
        server_alone = _server_rate(served, wear, seconds)
        threading.Thread(target=served.serve_forever, args=(0.05,), daemon=True).start()
        console.step("playing in Chromium")
        with browser_page(width, height) as tab:
            found = _page_rates(tab, served.url, seconds)
        served.shutdown()
    console.result({**found, "server_alone_fps": server_alone, "window": [width, height]})


def _server_rate(served: Viewer, wear: tuple[str, ...], seconds: float) -> float:
    """Frames per second that the session makes when nobody draws them."""
    stream = served.session.stream(FrameRequest(wear=wear))
    for _ in islice(stream, 3):  # compilation and first use of memory
        pass
    started, count = time.perf_counter(), 0
    while time.perf_counter() - started < seconds / 2:
        next(stream)
        count += 1
    return round(count / (time.perf_counter() - started), 1)


def _page_rates(tab: Page, address: str, seconds: float) -> dict[str, Any]:
    tab.open(address)
    tab.wait_for("gw.ready && !asking && !waiting && !sorting")
    drawing = tab.run(_DRAWING.replace("COUNT", "5"))
    tab.run("play(), 0")
    time.sleep(seconds)
    page, detail = tab.run("gw.rate"), tab.run("gw.detail")
    tab.run("stop()")
    return {
        "gaussians": tab.run("gw.canvas.gaussians.count"),
        "page_fps": round(page, 1),
        "page_detail": round(detail, 2),
        "drawing_alone_fps": round(drawing, 1),
        "renderer": tab.run(_RENDERER),
    }


app = application(viewer)

if __name__ == "__main__":
    app()
