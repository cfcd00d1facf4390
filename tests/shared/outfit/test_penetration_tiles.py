"""The penetration pass on tile lists gives the bytes of the pass on whole pictures of every layer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.shared.capture import Camera
from stages.shared.layers import NO_LABEL
from stages.shared.outfit.penetration import TRYON_MARGINS, PenetrationConfig
from stages.shared.outfit.render_image import RenderedImage, render_image
from stages.shared.outfit.viewpoints import look_at_camera
from stages.shared.splat.api import rasterize
from stages.shared.splat.gaussians import Gaussians
from stages.shared.splat.settings import SplatSettings

NAMES = ("body", "lower", "upper", "outer")
FIELDS = ("color", "alpha", "depth", "labels", "repaired")


def _onion(layers: int, seed: int, poking: float = 0.012, thin: float = 0.3) -> Gaussians:
    """Rough shells one centimetre apart, so that inner ones poke through; an arm of the body in front."""
    random = np.random.default_rng(seed)
    means, ids = [], []
    for layer in range(layers):
        count = 2500
        direction = random.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        bump = poking * np.sin(9 * direction[:, 0]) * np.cos(7 * direction[:, 1]) * (1 if layer % 2 else -1)
        where = direction * (0.3 + 0.01 * layer + bump)[:, None]
        keep = direction[:, 1] > (-2.0, -0.4, -0.7, 0.0)[layer]
        means.append(where[keep])
        ids.append(np.full(int(keep.sum()), layer))
    arm = np.stack([random.uniform(-0.3, 0.3, 400), random.uniform(0, 0.06, 400), np.full(400, 0.45)], axis=1)
    means.append(arm)
    ids.append(np.zeros(400, np.int64))
    centres, layer_ids = np.concatenate(means), torch.from_numpy(np.concatenate(ids))
    order = random.permutation(len(centres))  # layers are not always in a row
    layer_ids, count = layer_ids[torch.from_numpy(order)], len(centres)
    sides = torch.from_numpy(random.uniform(0.008, 0.02, (count, 3)).astype(np.float32))
    opacities = np.where(random.random(count) < thin, random.uniform(0.05, 0.5, count), 0.97)
    colors = torch.from_numpy(random.random((count, 3)).astype(np.float32))
    return Gaussians(
        torch.from_numpy(centres[order].astype(np.float32)),
        torch.diag_embed(sides.square()),
        torch.from_numpy(opacities.astype(np.float32)),
        torch.cat([colors, torch.nn.functional.one_hot(layer_ids, layers).float()], dim=1),
        layer_ids,
        NAMES[:layers],
    )


def _camera(angle: float, size: tuple[int, int]) -> Camera:
    return look_at_camera("", np.zeros(3), angle, (0.36, 0.36, 0.5), size)


def _same(one: RenderedImage, other: RenderedImage) -> None:
    assert one.counts == other.counts
    for name in FIELDS:
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


@pytest.mark.parametrize("size", [(97, 130), (160, 64)])
@pytest.mark.parametrize("layers", [2, 3, 4])
def test_same_bytes_as_from_whole_pictures(layers: int, size: tuple[int, int]) -> None:
    found = 0
    for seed, margins in enumerate(
        (PenetrationConfig(), TRYON_MARGINS, PenetrationConfig(rim=0, opaque=0.5))
    ):
        composite = _onion(layers, seed)
        for angle in (0.0, 2.0):
            camera = _camera(angle, size)
            shot = render_image(composite, camera, margins)
            _same(shot, render_image(composite, camera, margins, each_layer=True))
            found += sum(shot.counts.values())
    assert found > 100, "nothing poked through: the scene tests nothing"


def test_same_bytes_with_coarse_cut_offs_and_two_threads() -> None:
    composite, camera = _onion(3, 5), _camera(0.4, (120, 120))
    coarse = SplatSettings(alpha_min=0.02, transmittance_min=0.01)
    alone = render_image(composite, camera, TRYON_MARGINS, settings=coarse)
    _same(alone, render_image(composite, camera, TRYON_MARGINS, each_layer=True, settings=coarse))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        _same(alone, render_image(composite, camera, TRYON_MARGINS, settings=coarse))
    finally:
        torch.set_num_threads(before)
    fine = render_image(composite, camera, TRYON_MARGINS)
    assert not np.array_equal(fine.color, alone.color), "cut-offs reach the splatting"


def test_the_pass_changes_pictures_and_keeps_an_arm() -> None:
    composite, camera = _onion(2, 1), _camera(0.0, (128, 128))
    before, after = render_image(composite, camera), render_image(composite, camera, TRYON_MARGINS)
    assert after.repaired is not None and after.repaired.sum() == after.counts["body/lower"] > 5
    assert (before.labels[after.repaired] == 0).all() and (after.labels[after.repaired] != 0).all()
    arm = composite.means[:, 2] > 0.44
    solid = replace(composite, opacities=torch.where(arm, 0.99, composite.opacities))
    shots = [render_image(solid, camera, margins) for margins in (None, TRYON_MARGINS)]
    where = (shots[0].labels == 0) & (shots[0].depth < float(shots[0].depth[shots[0].depth > 0].min()) + 0.03)
    assert where.sum() > 100 and np.array_equal(shots[1].labels[where], shots[0].labels[where])


def test_nothing_in_view_and_nothing_covered() -> None:
    composite = _onion(2, 0)
    away = replace(composite, means=composite.means + torch.tensor([50.0, 0.0, 0.0]))
    shot = render_image(away, _camera(0.0, (64, 48)), TRYON_MARGINS)
    assert not shot.alpha.any() and (shot.labels == NO_LABEL).all() and shot.counts == {"body/lower": 0}
    bare = replace(composite, opacities=composite.opacities * (composite.layer_ids == 0))
    shot = render_image(bare, _camera(0.0, (64, 48)), TRYON_MARGINS)
    assert shot.counts == {"body/lower": 0} and shot.repaired is not None and not shot.repaired.any()


def test_a_developed_picture_is_what_the_formulas_say() -> None:
    composite, camera = _onion(3, 2), _camera(1.0, (90, 70))
    bright = replace(composite, features=composite.features * 1.6 - 0.2)
    view, intrinsics = camera.tensors()
    raw = rasterize(
        bright.means, None, None, bright.opacities, bright.features, view, intrinsics, 90, 70,
        covars=bright.covariances,
    )  # fmt: skip
    shot = render_image(bright, camera)
    assert np.array_equal(shot.color, raw.features[..., :3].clamp(0, 1).numpy())
    assert np.array_equal(shot.depth, raw.expected_depth.numpy())
    ids = np.array([0, 4, 3])
    wanted = np.where(raw.alpha >= 0.5, ids[raw.features[..., 3:].argmax(dim=2).numpy()], NO_LABEL)
    assert np.array_equal(shot.labels, wanted) and len(np.unique(wanted)) == 4
