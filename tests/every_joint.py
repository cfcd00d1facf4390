"""Skin with all joints: the slow way that the fast one is compared with."""

from __future__ import annotations

import sys
from typing import Any
from unittest.mock import patch

from stages.shared.avatar import used_joints


def every_joint() -> Any:
    """Context in which all 55 joints take part in skinning, also those at rest or without weight."""
    return patch.object(used_joints, "FEWEST_TEXELS", sys.maxsize)
