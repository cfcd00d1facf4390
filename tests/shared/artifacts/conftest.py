"""A small capture and two stages that stand on each other."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from stages.shared.artifacts import Artifact, ExternalFiles, StageSpec, Workspace

FIRST = StageSpec("first", "gw first CAPTURE -o SUBJECT", ())
SECOND = StageSpec("second", "gw second SUBJECT", ("first",))


@dataclass(frozen=True)
class Config:
    grid: int = 64
    sizes: tuple[float, ...] = (1.0, 2.5)
    device: str = field(default="auto", metadata={"affects_result": False})


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A capture with one file of poses and four label images."""
    folder = tmp_path / "capture"
    for camera in ("Cam001", "Cam002"):
        for frame in range(2):
            path = folder / "labels" / camera / f"label-f{frame:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(f"{camera} {frame}".encode())
    (folder / "poses.npz").write_bytes(b"poses")
    return folder


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "subject")


def poses(capture: Path) -> ExternalFiles:
    return ExternalFiles("capture/poses", capture, [capture / "poses.npz"])


def labels(capture: Path) -> ExternalFiles:
    return ExternalFiles("capture/labels", capture, sorted(capture.glob("labels/*/*.png")))


def make_first(
    workspace: Workspace, capture: Path, config: Config = Config(), force: bool = False
) -> Artifact:
    """Files of every kind the store writes."""
    with workspace.build(FIRST, config, {"capture/poses": poses(capture)}, force=force) as build:
        vertices = np.arange(12, dtype=np.float32).reshape(4, 3) * config.grid
        build.write_arrays(
            "template",
            {
                "vertices": vertices,
                "faces": np.array([[0, 1, 2]], np.int32),
                "seams": np.zeros((0, 2), np.int32),
            },
            about={"vertices": "m world (V,3)"},
        )
        build.write_json("report", {"share_inside": np.float32(0.5), "cameras": ("a", "b")})
        build.write_picture("overlay.png", np.arange(60, dtype=np.uint8).reshape(4, 5, 3))
        build.write_bytes("previews/film.mp4", b"film")
        build.summary(vertices=4, sizes=config.sizes)
        build.measured(frames_per_second=3.5)
    return build.artifact


def make_second(workspace: Workspace, capture: Path, first: Artifact) -> Artifact:
    inputs: dict[str, Artifact | ExternalFiles] = {"first": first, "capture/labels": labels(capture)}
    with workspace.build(SECOND, Config(), inputs) as build:
        build.write_arrays("lower", {"vertices": first.arrays("template")["vertices"] + 1})
    return build.artifact
