"""Costs are counted from what is there: nothing for what a layer does without."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.blendshapes import BlendshapeDecoder, BlendshapeSizes
from stages.shared.avatar.decoders.components import bytes_by_component, component_of
from stages.shared.avatar.decoders.cost import costs, multiply_adds, operations
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.nets.styleunet import StyleUNet
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube_arrays

SMALL = ModelConfig(width=0.0625, depth=2, style=8, factor=4)


def _maps(layer: str = "lower", high: float = 0.3) -> LayerMaps:
    return LayerMaps.from_arrays(layer, tube_arrays(high=high), PITCH, CENTRE, GRID)


def test_without_networks_and_anchors_there_is_nothing_but_skinning_and_splatting() -> None:
    bare = replace(SMALL, networks="none")
    assert set(multiply_adds(_maps(), bare)) == {"skinning", "splatting at 512 x 512"}
    anchored = multiply_adds(_maps(), replace(bare, anchors=3))
    assert set(anchored) == {"skinning", "splatting at 512 x 512", "positional map", "anchors"}
    assert set(multiply_adds(_maps("body"), replace(bare, anchors=3))) == set(multiply_adds(_maps(), bare))


def test_anchors_cost_what_their_arrays_multiply() -> None:
    model = StyleUNetDecoder(_maps(), replace(SMALL, networks="none", anchors=5, history=2))
    assert model.anchors is not None
    count = operations(model)["anchors"]
    assert count == model.anchors.poses.numel() + model.anchors.offsets.numel() + 12 * len(model.maps)
    cells, joints = model.positional.weights.shape[0], 2
    assert operations(model)["positional map"] == cells * (12 * joints + 9)


def test_blendshapes_cost_what_their_arrays_multiply() -> None:
    config = replace(SMALL, decoder="blendshapes", history=1)
    model = BlendshapeDecoder(_maps(), config, BlendshapeSizes(6, 3, 2, 7))
    count = operations(model)
    bases = sum(p.numel() for name, p in model.named_parameters() if name.startswith("basis_"))
    kernel = model.coefficients
    assert count["blendshapes"] == bases
    assert count["pose coefficients"] == kernel.centres.numel() + kernel.weights.numel()
    assert "networks" not in count and "anchors" not in count


def test_networks_are_counted_from_their_graph() -> None:
    """Convolutions of one network that were really run, by an independent count of their outputs."""
    model = StyleUNetDecoder(_maps(), SMALL)
    network: StyleUNet = model.networks[0]  # type: ignore[assignment]
    seen = []
    plain = torch.nn.functional.conv2d

    def counting(image, weight, *rest, **more):  # type: ignore[no-untyped-def]
        found = plain(image, weight, *rest, **more)
        seen.append(found.numel() * weight[0].numel())
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.nn.functional, "conv2d", counting)
        grid = model.positional.grid
        with torch.no_grad():
            network(torch.zeros(1, model.positional.channels, grid.height, grid.width))
    count = operations(model)["networks"]
    assert sum(seen) > 0.3 * count
    assert sum(seen) <= count
    taller = LayerMaps.from_arrays("lower", tube_arrays(low=-0.9, high=0.9), PITCH, CENTRE, GRID)
    assert multiply_adds(taller, SMALL)["networks"] > 1.8 * count
    apart = multiply_adds(model.maps, replace(SMALL, heads="separate"))["networks"]
    assert apart > 2 * count


def test_resting_hands_cost_nothing() -> None:
    arrays = tube_arrays()
    arrays["skin_weights"][:] = 0
    arrays["skin_weights"][:, [20, 25, 26, 27]] = 0.25
    maps = LayerMaps.from_arrays("body", arrays, PITCH, CENTRE, GRID)
    moving, still = multiply_adds(maps, SMALL), multiply_adds(maps, SMALL, resting=("left hand",))
    assert moving["skinning"] - still["skinning"] == 3 * 12 * len(maps)
    assert moving["positional map"] > 2 * still["positional map"]
    assert costs(StyleUNetDecoder(maps, SMALL), ("left hand",))["joints"] == 1


def test_every_stored_tensor_belongs_somewhere() -> None:
    models = (
        StyleUNetDecoder(_maps(), replace(SMALL, anchors=2, history=1, pose_prior=2)),
        StyleUNetDecoder(_maps(), replace(SMALL, heads="separate", view_conditioning=True)),
        BlendshapeDecoder(_maps(), replace(SMALL, decoder="blendshapes"), BlendshapeSizes(2, 1, 1, 3)),
    )
    for model in models:
        state = model.state()
        assert all(component_of(name) != "other" for name in state), list(state)
        sizes = {name: 4 * tensor.numel() for name, tensor in state.items()}
        assert sum(bytes_by_component(sizes).values()) == sum(sizes.values())
    assert component_of("something_new") == "other"
