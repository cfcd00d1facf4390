"""A page that shows an outfit from all sides, still or in motion: one file that needs no server.

Reads: what `gw render` reads. Writes: one HTML file with the Gaussians inside, the code that draws them, and
switches for layers; it asks for nothing from anywhere. One frame is written as it is (22 bytes a Gaussian);
several frames become a clip that the page skins and plays (`clip.py`).
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib import resources
from pathlib import Path
from typing import Any

from stages.render.clip import pack_clip
from stages.shared.artifacts import write_whole
from stages.shared.errors import UsageProblem
from stages.shared.pictures.background import read_background
from stages.shared.plan import Plan
from stages.shared.render_sequence.config import RenderConfig
from stages.shared.render_sequence.outputs import video_rate
from stages.shared.render_sequence.sequence import RenderSequence, open_sequence
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_file_target
from stages.shared.web.pack import pack_gaussians
from stages.shared.web.start import orbit_start, viewer_script


def run(
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    output: Path,
    config: RenderConfig = RenderConfig(),
    report: Report = SILENT,
) -> dict[str, Any]:
    """Write the page of the frames that `config` names; returns path, frames, layers, Gaussians, bytes.

    Raises:
        UsageProblem: what cannot be meant; an output that is a folder. MissingInput, BadData: inputs.
        StorageFailure: disk full.
    """
    color, scene = _checked(output, config), _open(sources, poses_path, cameras_path, config)
    report.step("writing the page")
    frame, rows = scene.frames[0], [each.row for each in scene.frames]
    composite = scene.outfit.composite(scene.poses, frame.row)
    start, title = orbit_start(frame.cameras[0], composite), " + ".join(composite.layers)
    if len(rows) > 1:
        rate = video_rate(scene.poses.fps, scene.frames)
        content = pack_clip(scene.outfit, scene.poses, rows, rate, report)
    else:
        content = pack_gaussians(composite)
    page = page_text(content, start, color, title)
    write_whole(output, page)
    return {
        "page": str(output),
        "frame": frame.row,
        "frames": len(rows),
        "layers": list(scene.outfit.names),
        "gaussians": scene.outfit.gaussians,
        "bytes": len(page),
    }


def plan(
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    output: Path,
    config: RenderConfig = RenderConfig(),
) -> Plan:
    """What `run` would read, write and cost."""
    _checked(output, config)
    scene = _open(sources, poses_path, cameras_path, config)
    count = scene.outfit.gaussians
    return Plan(
        inputs=[str(path) for path in (*sources, poses_path, cameras_path) if path is not None],
        outputs=[str(output)],
        config={**asdict(config), "layers": list(scene.outfit.names)},
        seconds=3.0 + 1e-5 * count,
        memory_bytes=600_000_000 + 3000 * count,
        disk_bytes=40_000
        + 32 * count
        + (3600 * len(scene.frames) + 8 * count if len(scene.frames) > 1 else 0),
    )


def page_text(content: bytes, start: dict[str, object], background: str, title: str) -> bytes:
    """The page as bytes. start: `orbit_start`'s. background: #rrggbb."""
    text = resources.files("stages.render").joinpath("page.html").read_text("utf-8")
    for name, value in (
        ("TITLE", html.escape(title)),
        ("BACKGROUND", background),
        ("START", json.dumps(start)),
        ("VIEWER", viewer_script()),
        ("CLIP", viewer_script("clip.js")),
        ("GAUSSIANS", base64.b64encode(content).decode()),
    ):
        text = text.replace(f"@{name}@", value)
    return text.encode()


def _open(
    sources: Sequence[Path], poses_path: Path | None, cameras_path: Path | None, config: RenderConfig
) -> RenderSequence:
    """The scene, with a camera that stands still where the configuration names none."""
    orbiting = replace(config, camera="static") if config.camera == "orbit" else config
    return open_sequence(sources, poses_path, cameras_path, orbiting)


def _checked(output: Path, config: RenderConfig) -> str:
    """The background as #rrggbb; white for a transparent one."""
    check_file_target(output, "--html a.html")
    background = read_background(config.background)
    if background.picture is not None:
        raise UsageProblem(
            "A page has a plain background.", "option --background", "Give a colour together with --html."
        )
    color = background.color or (1.0, 1.0, 1.0)
    return "#" + "".join(f"{round(255 * value):02x}" for value in color)
