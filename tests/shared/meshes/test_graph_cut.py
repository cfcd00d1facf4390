"""Graph cut against enumeration of all labellings."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stages.shared.meshes.labelling import alpha_expansion, energy, expand


def problem(seed: int, count: int, labels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    costs = generator.uniform(0, 2, size=(count, labels))
    pairs = np.array(list(itertools.combinations(range(count), 2)))
    edges = pairs[generator.random(len(pairs)) < 0.5]
    return costs, edges, generator.uniform(0, 1.5, len(edges))


@pytest.mark.parametrize("seed", range(12))
def test_two_labels_are_solved_exactly(seed: int) -> None:
    costs, edges, weights = problem(seed, 8, 2)
    best = min(energy(np.array(x), costs, edges, weights) for x in itertools.product(range(2), repeat=8))
    found = alpha_expansion(costs, edges, weights, sweeps=3)
    assert energy(found, costs, edges, weights) == pytest.approx(best, abs=5e-3)


@pytest.mark.parametrize("seed", range(8))
def test_an_expansion_is_the_best_of_all_its_moves(seed: int) -> None:
    costs, edges, weights = problem(100 + seed, 8, 4)
    start = np.random.default_rng(seed).integers(0, 4, 8)
    moves = (np.where(x, 2, start) for x in itertools.product([False, True], repeat=8))
    best = min(energy(move, costs, edges, weights) for move in moves)
    assert energy(expand(start, 2, costs, edges, weights), costs, edges, weights) == pytest.approx(
        best, abs=5e-3
    )


@pytest.mark.parametrize("seed", range(6))
def test_several_labels_come_close_to_the_optimum(seed: int) -> None:
    costs, edges, weights = problem(200 + seed, 7, 3)
    best = min(energy(np.array(x), costs, edges, weights) for x in itertools.product(range(3), repeat=7))
    found = energy(alpha_expansion(costs, edges, weights, sweeps=4), costs, edges, weights)
    assert best - 1e-3 <= found <= 1.1 * best


def test_without_edges_every_vertex_takes_its_cheapest() -> None:
    costs = np.random.default_rng(0).random((30, 5))
    found = alpha_expansion(costs, np.zeros((0, 2), int), np.zeros(0), 2)
    np.testing.assert_array_equal(found, costs.argmin(axis=1))


def test_a_lone_dissenter_on_a_chain_is_overruled() -> None:
    costs = np.tile([0.0, 1.0], (9, 1))
    costs[4] = [1.0, 0.0]
    edges = np.stack([np.arange(8), np.arange(1, 9)], axis=1)
    assert alpha_expansion(costs, edges, np.full(8, 0.2), 2)[4] == 1
    assert (alpha_expansion(costs, edges, np.full(8, 0.8), 2) == 0).all()
