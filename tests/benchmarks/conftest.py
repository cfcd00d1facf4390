"""The tiny subject and wardrobe that the tests of stages read too."""

from tests.stages.conftest import dressed_subject, wardrobe

__all__ = ["dressed_subject", "wardrobe"]
