"""Fixtures every test may use; real input is optional and skipped with a reason when it is absent."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("markexpr"):
        return
    skip = pytest.mark.skip(reason="long check: run `make test-long`")
    for item in items:
        if "long" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def shared_folder() -> Path:
    """Folder of real sample input beside the checkout."""
    if not SHARED.is_dir():
        pytest.skip("no real sample input beside the checkout (../shared)")
    return SHARED


@pytest.fixture(scope="session")
def subject_a(shared_folder: Path) -> Path:
    """The multi-view capture in ActorsHQ layout."""
    folder = shared_folder / "captures" / "subject_a"
    if not folder.is_dir():
        pytest.skip("no capture subject_a beside the checkout (../shared/captures/subject_a)")
    return folder
