"""Fabrics and colour."""

from __future__ import annotations

import numpy as np
import pytest

from stages.shared.pictures.srgb import linear_from_srgb, srgb_from_linear
from stages.synth.textures import (
    ARGYLE,
    CHECKS,
    DOTS,
    STRIPES,
    TARTAN,
    Fabric,
    fabric_color,
)

COLORS = ((0.9, 0.9, 0.9), (0.1, 0.1, 0.5), (0.8, 0.2, 0.1), (0.2, 0.7, 0.2))


def _color(fabric: Fabric, u: float, v: float) -> np.ndarray:
    out = np.zeros(3)
    fabric_color(fabric.row(), u, v, out)
    return out


def test_srgb_there_and_back() -> None:
    values = np.linspace(0, 1, 256)
    assert srgb_from_linear(linear_from_srgb(values)) == pytest.approx(values, abs=1e-9)
    assert linear_from_srgb(np.array([0.5]))[0] == pytest.approx(0.21404, abs=1e-5)


@pytest.mark.parametrize("kind", [STRIPES, TARTAN, CHECKS, DOTS, ARGYLE])
def test_patterns_repeat_and_have_contrast(kind: int) -> None:
    fabric = Fabric(kind, 0.05, COLORS)
    points = np.random.default_rng(kind).uniform(-0.2, 0.2, (300, 2))
    here = np.array([_color(fabric, u, v) for u, v in points])
    there = np.array([_color(fabric, u + 0.05, v - 0.10) for u, v in points])
    assert np.mean(np.abs(here - there).max(axis=1) > 1e-9) < 0.01  # rounding at an edge
    assert len(np.unique(here.round(6), axis=0)) >= 2


def test_a_badge_covers_only_its_disc() -> None:
    plain, badge = Fabric(STRIPES, 0.05, COLORS), Fabric(STRIPES, 0.05, COLORS, emblem=(0.1, 0.2, 0.03))
    assert _color(badge, 0.1, 0.2) == pytest.approx(linear_from_srgb(np.array(COLORS[3])))
    assert _color(badge, 0.131, 0.2) == pytest.approx(_color(plain, 0.131, 0.2))
