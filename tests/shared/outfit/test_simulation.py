"""Simulated garments in an outfit: same bytes for any rows, cuts, single poses, larger bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from stages.shared.body import Poses, embedded_body
from stages.shared.cloth.material import TIGHT
from stages.shared.cloth.motion import LONGEST_STEP, is_cut, lead_in, steps_between
from stages.shared.cloth.riding import ridden
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.simulation import OutfitSimulation
from tests.shared.outfit.wardrobe import bundle, motion, simulated, worn

FAST = replace(TIGHT, steps_per_second=300.0)
LOWER = simulated("lower", FAST)
POSES = motion(4)


def _dressed(betas: np.ndarray | None = None) -> Outfit:
    shape = np.zeros(10, np.float32) if betas is None else betas
    return Outfit(embedded_body(), shape, (worn("body"), LOWER)).driven("auto")


def test_the_mesh_moves_texels_with_their_riding_places() -> None:
    """Centres are where the texels ride; both ways of posing agree; covariances keep their size."""
    dressed = _dressed()
    driver = dressed.drivers["lower"]
    assert driver.kind == "simulated"
    posed = dressed.posed(POSES, 2)["lower"]
    vertices = driver._simulation.positions(POSES, 2)["lower"]  # type: ignore[attr-defined]
    assert LOWER.cloth is not None
    places, _ = ridden(LOWER.cloth.riding, vertices, LOWER.cloth.faces)
    np.testing.assert_allclose(posed.means.numpy(), places, atol=2e-6)
    cached = CachedPoser(dressed).composite(POSES, 2)
    first = len(dressed.layers[0].maps)
    np.testing.assert_allclose(cached.means[first:].numpy(), posed.means.numpy(), atol=5e-6)
    plain = replace(dressed, drivers={}).posed(POSES, 2)["lower"]
    trace = torch.diagonal(posed.covariances, dim1=1, dim2=2).sum(dim=1)
    assert torch.allclose(trace, torch.diagonal(plain.covariances, dim1=1, dim2=2).sum(dim=1), rtol=0.2)


def test_a_garment_is_cut_for_its_wearer_unless_it_keeps_its_own_size() -> None:
    """Edges of a skirt grow with a larger body, and not on the person it was learned from."""
    assert LOWER.cloth is not None
    body, large = embedded_body(), np.zeros(10, np.float32)
    large[0] = 3.0
    same = LOWER.cloth.graded(body, np.zeros(10, np.float32)).rest_lengths
    np.testing.assert_array_equal(same, LOWER.cloth.rest_lengths)
    assert np.median(LOWER.cloth.graded(body, large).rest_lengths / LOWER.cloth.rest_lengths) > 1.05
    shape = Outfit(body, large, (worn("body"), LOWER))
    widths = {}
    for drive in ("simulated", "own-size"):
        vertices = shape.driven(drive).drivers["lower"]._simulation.positions(POSES, 3)["lower"]  # type: ignore[attr-defined]
        widths[drive] = np.linalg.norm(np.diff(vertices[LOWER.cloth.faces[:, :2]], axis=1), axis=-1).mean()
    assert widths["simulated"] > 1.02 * widths["own-size"]


def test_rows_in_any_order_are_the_same_bytes() -> None:
    forward, backward = _dressed(), _dressed()
    one = [forward.posed(POSES, row)["lower"].means.numpy().tobytes() for row in (0, 1, 2, 3)]
    backward.prepare(POSES, [3])
    other = [backward.posed(POSES, row)["lower"].means.numpy().tobytes() for row in (3, 1, 0, 2)]
    assert other == [one[row] for row in (3, 1, 0, 2)]


def test_a_simulation_on_top_of_another_has_the_bytes_of_one_of_both() -> None:
    """Also across a cut, after which the garments settle again."""
    upper = simulated("upper", FAST)
    assert LOWER.cloth is not None and upper.cloth is not None
    moved = POSES.translation.copy()
    moved[2:] += [40.0, 0.0, 0.0]
    poses, body, betas = replace(POSES, translation=moved), embedded_body(), np.zeros(10)
    both = {"lower": LOWER.cloth, "upper": upper.cloth}
    beneath = OutfitSimulation(body, betas, {"lower": LOWER.cloth}, keep_steps=True)
    beneath.positions(poses, 3)
    at_once = OutfitSimulation(body, betas, both).positions(poses, 3)
    on_top = OutfitSimulation(body, betas, both, beneath=beneath).positions(poses, 3)
    assert [at_once[name].tobytes() for name in both] == [on_top[name].tobytes() for name in both]


def test_a_jump_of_the_root_is_a_cut_and_settles_again() -> None:
    """After the jump the garment is around the body again, and not left behind or torn."""
    moved = POSES.translation.copy()
    moved[2:] += [40.0, 0.0, 0.0]
    jumping = replace(POSES, translation=moved)
    body = embedded_body()
    assert [is_cut(body, jumping, row) for row in range(4)] == [True, False, True, False]
    means = _dressed().posed(jumping, 2)["lower"].means.numpy()
    assert abs(means[:, 0].mean() - 40.0) < 0.05 and np.ptp(means[:, 0]) < 0.5


def test_steps_are_short_and_the_lead_in_begins_in_the_templates_pose() -> None:
    slow = replace(POSES, fps=8.0)
    steps = list(steps_between(slow, 1))
    assert len(steps) == 3 and max(step.seconds for step in steps) <= LONGEST_STEP
    np.testing.assert_allclose(steps[-1].rotations, POSES.rotations[1], atol=1e-6)
    turned = POSES.rotations.copy()
    turned[:, 0, 1] = 2.0
    pose = np.zeros((55, 3), np.float32)
    pose[16, 2] = 0.3
    way = list(lead_in(pose, replace(POSES, rotations=turned), 1))
    np.testing.assert_allclose(way[0].rotations[0], [0.0, 2.0, 0.0], atol=1e-6)  # faces the right way
    np.testing.assert_allclose(way[0].rotations[16], pose[16], atol=1e-6)
    np.testing.assert_allclose(way[-1].rotations, turned[1], atol=1e-6)


def test_every_frame_rate_and_noise_poses_stay_finite() -> None:
    draw = np.random.default_rng(7)
    noise = replace(POSES, rotations=draw.normal(0, 1.0, POSES.rotations.shape).astype(np.float32))
    for poses in (replace(POSES[[1]], fps=30.0), replace(POSES, fps=240.0), noise[[0, 1]]):
        means = _dressed().posed(poses, len(poses) - 1)["lower"].means.numpy()
        assert np.isfinite(means).all() and np.ptp(means, axis=0).max() < 1.5


def test_a_bundle_carries_the_simulation_to_another_body() -> None:
    named = [("body", bundle(worn("body"))), ("lower", bundle(LOWER))]
    larger = np.zeros(10, np.float32)
    larger[0] = 1.0
    dressed = outfit_of_bundles(named, larger).driven("auto")
    assert dressed.drivers["lower"].kind == "simulated"
    own = outfit_of_bundles(named, np.zeros(10, np.float32)).driven("auto")
    change = dressed.posed(POSES, 0)["lower"].means - own.posed(POSES, 0)["lower"].means
    assert torch.isfinite(change).all() and change.norm(dim=1).max() > 1e-4
    assert outfit_of_bundles(named).driven("auto", trained_poses=True).drivers["lower"].kind == "learned"


def test_garments_lie_over_one_another() -> None:
    """The outer of two tubes stays outside the inner one where they overlap."""
    upper = simulated("upper", FAST)
    patterns = {name: layer.cloth for name, layer in (("lower", LOWER), ("upper", upper))}
    simulation = OutfitSimulation(embedded_body(), np.zeros(10), patterns)  # type: ignore[arg-type]
    at = simulation.positions(POSES, 3)
    assert set(at) == {"lower", "upper"} and np.isfinite(at["upper"]).all()
    still = Poses(
        *(getattr(POSES[[0]], name) for name in ("rotations", "translation", "betas", "expression"))
    )
    assert np.isfinite(simulation.positions(still, 0)["upper"]).all()
