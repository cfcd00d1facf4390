"""One tiny chain for all tests of the pipeline."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.pipeline.chain import make_chain


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two tiny people as captures, and subject 1 taken through the five stages."""
    return make_chain(tmp_path_factory.mktemp("chain"))
