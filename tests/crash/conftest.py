"""A capture, and what an undisturbed run makes of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from stages.shared.artifacts.files import using_layer
from tests.crash.fake_stage import CountingLayer, run


@pytest.fixture(scope="session")
def crash_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("crash") / "capture"
    folder.mkdir()
    for frame in range(3):
        (folder / f"{frame}.png").write_bytes(bytes([frame]) * 1000)
    return folder


@pytest.fixture(scope="session")
def undisturbed(crash_capture: Path) -> tuple[tuple[str, str], list[str]]:
    """Digests of both artifacts, and the kinds of all calls of the file layer in their order."""
    with using_layer(CountingLayer()) as layer:
        prepared, learnt, steps = run(crash_capture.parent / "undisturbed", crash_capture)
    assert isinstance(layer, CountingLayer) and steps == 8
    return (prepared, learnt), layer.calls
