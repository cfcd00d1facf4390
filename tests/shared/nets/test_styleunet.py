"""The network has the published structure: parameters, shapes, resampling."""

from __future__ import annotations

import pytest
import torch

from stages.shared.nets.layers import double, haar, halve, inverse_haar
from stages.shared.nets.styleunet import StyleUNet, ViewNet


def _count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_published_size_has_the_published_number_of_parameters() -> None:
    with torch.device("meta"):
        color, offset = StyleUNet(3, 3, (512, 512)), StyleUNet(3, 3, (512, 512))
        other, view = StyleUNet(3, 8, (512, 512)), ViewNet()
    assert _count(color) == 74_479_016
    assert _count(other) == 74_558_616
    assert _count(view) == 132_288
    assert sum(map(_count, (color, offset, other, view))) == 223_648_936


def test_published_output_shape_without_allocating_it() -> None:
    with torch.device("meta"):
        network, view = StyleUNet(3, 3, (512, 512)), ViewNet()
        features = view(torch.empty(2, 1, 512, 512))
        assert features.shape == (2, 128, 256, 256)
        output = network(torch.empty(1, 3, 512, 512), (features[:1], features[1:]))
    assert output.shape == (1, 2, 3, 1024, 1024)


@pytest.mark.parametrize(
    ("size", "depth", "width"), [((8, 16), 3, 0.0625), ((24, 8), 2, 0.25), ((16, 16), 4, 0.1)]
)
def test_any_size_and_width(size: tuple[int, int], depth: int, width: float) -> None:
    torch.manual_seed(0)
    network = StyleUNet(6, 14, size, depth, width, style=16)
    image = torch.randn(2, 6, *size)
    output = network(image)
    assert output.shape == (2, 2, 14, 2 * size[0], 2 * size[1])
    assert output.abs().max() == 0, "a fresh network answers zero"
    for name, parameter in network.named_parameters():
        if "to_bands" in name:
            torch.nn.init.normal_(parameter)
    output = network(image)
    assert torch.isfinite(output).all() and output.std() > 0.01
    assert not torch.equal(output[:, 0], output[:, 1]), "the decoders are their own"
    assert torch.allclose(network(image[1:])[0], output[1], atol=1e-5), "the batch does not mix"


def test_sizes_that_do_not_divide_are_refused() -> None:
    with pytest.raises(ValueError):
        StyleUNet(3, 3, (20, 16), depth=3)


def test_haar_is_orthonormal_and_inverse() -> None:
    image = torch.randn(2, 3, 6, 10, dtype=torch.float64)
    bands = haar(image)
    assert bands.shape == (2, 12, 3, 5)
    assert torch.allclose(inverse_haar(bands), image)
    assert bands.square().sum() == pytest.approx(image.square().sum().item())
    assert torch.allclose(bands[:, :3], 2 * torch.nn.functional.avg_pool2d(image, 2))


def test_resampling_keeps_a_constant_inside() -> None:
    image = torch.full((1, 2, 12, 8), 0.7, dtype=torch.float64)
    assert torch.allclose(halve(image)[:, :, 1:-1, 1:-1], torch.tensor(0.7, dtype=torch.float64))
    assert torch.allclose(double(image)[:, :, 2:-2, 2:-2], torch.tensor(0.7, dtype=torch.float64))
    assert halve(image).shape == (1, 2, 6, 4) and double(image).shape == (1, 2, 24, 16)


def test_recomputed_activations_give_the_same_gradients_to_the_bit() -> None:
    """And keep less: what the graph holds on to is counted."""
    torch.manual_seed(2)
    net = StyleUNet(3, 4, (32, 16), depth=2, width=0.125, style=8)
    for decoder in net.decoders:
        for bands in decoder.to_bands:  # zero at the start, which would hide every gradient
            torch.nn.init.normal_(bands.conv.weight)
    image = torch.randn(1, 3, 32, 16)
    views = (torch.randn(1, 16, 16, 8), torch.randn(1, 16, 16, 8))
    found, kept = [], []
    for net.recompute in (False, True):
        held: list[int] = []

        def count(tensor: torch.Tensor, held: list[int] = held) -> torch.Tensor:
            held.append(tensor.numel())
            return tensor

        leaves = tuple(view.clone().requires_grad_() for view in views)
        net.zero_grad(set_to_none=True)
        with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
            answer = net(image, leaves)
        answer.square().sum().backward()
        gradients = [p.grad for p in (*net.parameters(), *leaves)]
        found.append([answer.detach(), *(g for g in gradients if g is not None)])
        kept.append(sum(held))
    assert len(found[0]) == len(found[1]) > 20
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
    assert max(float(gradient.abs().max()) for gradient in found[0][1:]) > 0
    assert kept[1] < 0.1 * kept[0]
