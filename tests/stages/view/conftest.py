"""A viewer of a small wardrobe, listening in a thread."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from stages.view import stage
from stages.view.config import ViewConfig
from stages.view.server import Viewer


@pytest.fixture(scope="module")
def viewer(wardrobe: Path) -> Iterator[Viewer]:
    with stage.open_viewer(
        [wardrobe / "body.gwg", wardrobe / "lower.gwg"],
        wardrobe,
        [wardrobe / "motion.npz"],
        ViewConfig(port=0),
    ) as made:
        thread = threading.Thread(target=made.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        yield made
        made.shutdown()
        thread.join(10)
