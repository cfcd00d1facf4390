"""Body Gaussians left out beneath garments: nothing that can be seen changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.shared.outfit import visibility_culling as hidden_module
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.visibility_culling import dilate, find_hidden_texels, fully_covered
from stages.shared.render_sequence import frames as sequence_frames
from stages.shared.render_sequence.outputs import SequenceFrame, SequenceOutputs
from stages.shared.report import SILENT
from stages.shared.splat.api import contributions
from tests.shared.avatar.test_blendshapes import CONFIG as BLENDSHAPES
from tests.shared.outfit.wardrobe import bundle, cameras, motion, outfit, worn

POSES, ROWS = motion(9), list(range(9))


def _opaque(dressed: Outfit) -> Outfit:
    """Garments as trained ones are: nothing shines through."""
    for layer in dressed.layers[1:]:
        layer.model.base_opacity += 6.0
        layer.model.base_scale += 1.2
    return dressed


@pytest.fixture(scope="module")
def dressed() -> Outfit:
    return _opaque(outfit("body", "lower", "upper"))


@pytest.fixture(scope="module")
def plan(dressed: Outfit) -> np.ndarray:
    found = find_hidden_texels(dressed, POSES, ROWS)
    assert found is not None
    return found


def test_pictures_stay_what_they_are(dressed: Outfit, plan: np.ndarray) -> None:
    count = len(dressed.layers[0].maps)
    assert plan.shape == (count,) and 0.05 * count < plan.sum() < fully_covered(dressed).sum()
    whole, culled = CachedPoser(dressed), CachedPoser(dressed, hidden=plan)
    for row in (1, 4, 7):
        everything, rest = whole.composite(POSES, row), culled.composite(POSES, row)
        assert len(rest.means) == len(everything.means) - plan.sum()
        kept = np.concatenate([~plan, np.ones(len(everything.means) - count, bool)])
        assert torch.equal(rest.means, everything.means[kept])
        assert torch.equal(rest.features, everything.features[kept])
        for camera in cameras():
            for margins in (None, PenetrationConfig()):
                before, after = (render_image(x, camera, margins) for x in (everything, rest))
                assert np.square(before.color - after.color).mean() < 1e-6, "60 dB"
                assert np.array_equal(before.labels, after.labels)


def test_without_the_garments_the_body_is_whole(dressed: Outfit) -> None:
    bare = replace(dressed, layers=dressed.layers[:1])
    assert find_hidden_texels(bare, POSES, ROWS) is None and not fully_covered(bare).any()
    shirt = find_hidden_texels(replace(dressed, layers=(dressed.layers[0], dressed.layers[2])), POSES, ROWS)
    assert shirt is not None
    height = (
        dressed.layers[0].maps.positions[:, 1].numpy() - dressed.layers[2].maps.positions[:, 1].numpy().min()
    )
    assert height[shirt].min() > 0, "what a skirt had hidden is drawn again"


def test_what_shines_through_is_drawn(dressed: Outfit) -> None:
    thin = _opaque(outfit("body", "lower", "upper"))
    for layer in thin.layers[1:]:
        layer.model.base_opacity -= 9.0
    assert find_hidden_texels(thin, POSES, ROWS) is None


def test_swaps_and_blendshapes_are_left_out_alike() -> None:
    named = [(name, bundle(worn(name, source=name))) for name in ("body", "upper")]
    swapped = _opaque(outfit_of_bundles(named))
    assert swapped.swaps
    chosen = np.zeros(len(swapped.layers[0].maps), bool)
    chosen[5:300] = True
    from stages.shared.avatar.decoders.registry import new_decoder

    body = swapped.layers[0]
    shaped = new_decoder(body.maps, BLENDSHAPES, 3)
    with torch.no_grad():
        for parameter in shaped.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)) * 0.01)
    shaped.requires_grad_(False)
    for layer in (body, replace(body, model=shaped)):
        one = replace(swapped, layers=(layer, swapped.layers[1]))
        everything, rest = (
            CachedPoser(one).composite(POSES, 2),
            CachedPoser(one, hidden=chosen).composite(POSES, 2),
        )
        kept = np.ones(len(everything.means), bool)
        kept[5:300] = False
        for name in ("means", "covariances", "opacities", "features", "layer_ids"):
            assert torch.equal(getattr(rest, name), getattr(everything, name)[kept]), name


def test_contributions_are_what_a_colour_adds(dressed: Outfit) -> None:
    composite, camera = CachedPoser(dressed).composite(POSES, 3), cameras()[0]
    added = contributions(composite, camera)
    index = int(added.argmax())
    brighter = composite.features.clone()
    before = render_image(composite, camera).color.sum()
    brighter[index, :3] *= 0.5
    after = render_image(replace(composite, features=brighter), camera).color.sum()
    lost = float(0.5 * composite.features[index, :3].sum() * added[index])
    assert before - after == pytest.approx(lost, rel=1e-2) and added[index] > 0.5


def test_dilate() -> None:
    chain = np.array([[-1, 1, -1, -1], [0, 2, -1, -1], [1, 3, -1, -1], [2, -1, -1, -1]])
    start = np.array([True, False, False, False])
    assert dilate(start, chain, 0).tolist() == [True, False, False, False]
    assert dilate(start, chain, 2).tolist() == [True, True, True, False]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [({}, True), ({"cull": False}, False), ({"passes": ("layers",)}, False), ({"exports": ("ply",)}, False)],
)
def test_films_use_it_where_it_pays(
    dressed: Outfit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict, expected: bool
) -> None:
    drawn: list[int] = []
    genuine = sequence_frames.render_image

    def counted(composite: object, *rest: object, **options: object) -> object:
        drawn.append(len(composite.means))  # type: ignore[attr-defined]
        return genuine(composite, *rest, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(sequence_frames, "render_image", counted)
    frames = [SequenceFrame(row, (cameras()[0],)) for row in (0, 4)]
    config = replace(SequenceOutputs(), **changes)
    sequence_frames.write_frames(tmp_path / "short", dressed, POSES, frames, config, SILENT)
    assert set(drawn) == {dressed.gaussians}, "planning would take longer than the film"
    monkeypatch.setattr(sequence_frames, "LEAST_PICTURES", 2)
    monkeypatch.setattr(hidden_module, "MOST_POSES", 2)
    drawn.clear()
    sequence_frames.write_frames(tmp_path / "long", dressed, POSES, frames, config, SILENT)
    assert len(drawn) == 2 and (max(drawn) < dressed.gaussians) == expected
