"""The tiny subject and the bundles of the stage tests."""

from __future__ import annotations

from tests.stages.conftest import dressed_subject, wardrobe

__all__ = ["dressed_subject", "wardrobe"]
