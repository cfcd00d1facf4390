"""Layers without networks: what remains is what every texel has at rest, and the anchors."""

from __future__ import annotations

import pytest
import torch

from stages.shared.avatar.config import PAPER_MODEL, ModelConfig
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import embedded_body
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube_arrays

_SMALL = ModelConfig(width=0.0625, depth=2, style=8, factor=4, anchors=2, pose_prior=3)


def _model(layer: str, networks: str) -> StyleUNetDecoder:
    maps = LayerMaps.from_arrays(layer, tube_arrays(0.15), PITCH, CENTRE, GRID)
    return StyleUNetDecoder(maps, ModelConfig(**{**vars(_SMALL), "networks": networks}))


@pytest.mark.parametrize(
    ("networks", "layer", "count"),
    [("all", "body", 1), ("garments", "body", 0), ("garments", "upper", 1), ("none", "upper", 0)],
)
def test_only_the_layers_named_have_networks(networks: str, layer: str, count: int) -> None:
    model = _model(layer, networks)
    names = [name for name, _ in model.named_parameters() if not name.startswith(("base_", "anchors"))]
    assert len(model.networks) == count and bool(names) == bool(count)
    assert PAPER_MODEL.networks_of(layer) == (3, 3, 8)


def test_without_networks_the_body_is_its_base_and_a_garment_its_anchors() -> None:
    turned = torch.zeros(55, 3)
    poses = []
    for angle in (-0.4, 0.4):
        turned[3, 2] = angle
        poses.append(frame_pose(embedded_body(), turned, torch.zeros(3), torch.zeros(10)).local_transforms)
    body, shirt = _model("body", "none"), _model("upper", "none")
    assert torch.equal(body(poses[0]).offsets, body.base_offset)
    shirt.fit_input(poses)
    assert shirt.anchors is not None
    shirt.anchors.offsets.data[1] = 0.01
    found = [shirt(pose).offsets.mean().item() for pose in poses]
    assert found[1] > 0.008 > 0.002 > found[0]
    shirt(poses[1]).offsets.sum().backward()
    assert shirt.anchors.offsets.grad is not None and shirt.anchors.offsets.grad.abs().max() > 0
    restored = StyleUNetDecoder.from_state(shirt.config, shirt.maps, shirt.state())
    assert torch.equal(restored(poses[1]).offsets, shirt(poses[1]).offsets)
