"""The tiny subject and the bundles that the tests of the stages have."""

from __future__ import annotations

from tests.stages.conftest import dressed_subject, wardrobe

__all__ = ["dressed_subject", "wardrobe"]
