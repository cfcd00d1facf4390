"""View: outfits in the browser, live.

Reads:
    bundles `.gwg` and a folder of them, or a trained SUBJECT; pose files.
Writes:
    nothing; serves a page on this machine until it is interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stages.shared.input_files import CANONICAL
from stages.shared.outfit.sources import parse_betas
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report
from stages.view.catalog import open_catalog
from stages.view.config import ViewConfig
from stages.view.server import Viewer
from stages.view.session import UNCHANGED_MOTIONS, ViewerSession, canonical_motion


def open_viewer(
    sources: Sequence[Path],
    wardrobe: Path | None = None,
    poses: Sequence[Path] = (),
    config: ViewConfig = ViewConfig(),
    report: Report = SILENT,
) -> Viewer:
    """Read everything and begin to listen; the caller serves and closes.

    Arguments:
        sources: bundles worn at first, or one subject. wardrobe: folder of bundles to swap in.
        poses: motions to play. The canonical pose is always added, and a subject's own motion.

    Raises:
        UsageProblem, MissingInput, BadData: options and files. StorageFailure: the port is taken.
    """
    parse_betas(config.betas)
    report.step("reading")
    catalog, left_out = open_catalog(sources, wardrobe, config)
    for reason in left_out:
        report.warn(f"left out: {reason}")
    body = catalog.outfit(catalog.worn, None).body_model
    motions = [
        (path.name, load_poses(path, body, config.fps or None, report=report))
        for path in poses
        if str(path) != CANONICAL
    ]
    if catalog.subject_poses is not None:
        motions.append((UNCHANGED_MOTIONS[1], catalog.subject_poses))
    motions.append(canonical_motion())
    session = ViewerSession(catalog, motions, (config.width, config.height))
    return Viewer(config.host, config.port, session, config.betas)


def run(
    sources: Sequence[Path],
    wardrobe: Path | None,
    poses: Sequence[Path],
    config: ViewConfig = ViewConfig(),
    report: Report = SILENT,
    ready: Callable[[str], None] = lambda url: None,
) -> dict[str, Any]:
    """Serve until interrupted; `ready` is called with the address."""
    viewer = open_viewer(sources, wardrobe, poses, config, report)
    with viewer:
        ready(viewer.url)
        try:
            viewer.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            report.say("closed")
    return {"url": viewer.url}


def plan(
    sources: Sequence[Path], wardrobe: Path | None, poses: Sequence[Path], config: ViewConfig = ViewConfig()
) -> Plan:
    """What `run` would read; it writes nothing."""
    catalog, _ = open_catalog(sources, wardrobe, config)
    outfit = catalog.outfit(catalog.worn, parse_betas(config.betas))
    for path in poses:
        load_poses(path, outfit.body_model, config.fps or None)
    extra = [] if wardrobe is None else [wardrobe]
    return Plan(
        inputs=[str(path) for path in (*sources, *extra, *poses)],
        outputs=[],
        config={"layers": list(outfit.names), "host": config.host, "port": config.port},
        memory_bytes=600_000_000 + 3000 * outfit.gaussians,
    )
