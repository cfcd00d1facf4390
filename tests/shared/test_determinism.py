"""Trainings with the same seed have the same bits."""

from __future__ import annotations

import torch

from stages.shared.determinism import deterministic_sums


def _gradient() -> torch.Tensor:
    """Of a sum in which every entry is read many thousand times."""
    generator = torch.Generator().manual_seed(3)
    values = torch.randn(50, 8, generator=generator).requires_grad_()
    rows = torch.randint(0, 50, (200_000,), generator=generator)
    weights = torch.randn(200_000, 8, generator=generator)
    (values[rows] * weights).sum().backward()
    assert values.grad is not None
    return values.grad


def test_gradients_of_indexing_have_the_same_bits_every_time() -> None:
    with deterministic_sums(torch.device("cpu")):
        first, *others = [_gradient() for _ in range(5)]
    assert all(torch.equal(first, other) for other in others)


def test_the_setting_of_the_process_comes_back_and_other_devices_keep_theirs() -> None:
    assert not torch.are_deterministic_algorithms_enabled()
    with deterministic_sums(torch.device("meta")):
        assert not torch.are_deterministic_algorithms_enabled()
    with deterministic_sums(torch.device("cpu")):
        assert torch.are_deterministic_algorithms_enabled()
    assert not torch.are_deterministic_algorithms_enabled()
