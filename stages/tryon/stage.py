"""Try-on: a body wears garments of other people, in a new motion.

One of two doors to `stages/shared/render_sequence/run.py`, which says what is read and written. Its video is
called tryon.mp4 (or .webm), and its result.json has the format gw-tryon.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stages.shared.plan import Plan
from stages.shared.render_sequence import run as shared
from stages.shared.render_sequence.config import RenderConfig
from stages.shared.report import SILENT, Report


def run(
    bundles: Sequence[Path],
    poses_path: Path,
    output: Path,
    config: RenderConfig = RenderConfig(),
    report: Report = SILENT,
) -> shared.RenderResult:
    """Dress, pose, render and write. Arguments and errors are those of the shared `run`."""
    return shared.run(shared.TRYON, bundles, poses_path, None, output, config, report)


def plan(
    bundles: Sequence[Path], poses_path: Path, output: Path, config: RenderConfig = RenderConfig()
) -> Plan:
    """What `run` would read, write and cost."""
    return shared.plan(shared.TRYON, bundles, poses_path, None, output, config)
