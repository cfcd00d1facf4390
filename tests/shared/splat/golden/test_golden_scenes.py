"""Both rasterisers reproduce pictures, and gradients, of an independent one (`make_scenes.py`)."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from stages.shared.splat.api import rasterize
from stages.shared.splat.gaussians import Rendering
from tests.shared.splat.golden.make_scenes import FOLDER

_INPUTS = ("means", "quats", "scales", "opacities", "colors")


def _render(scene: dict[str, Tensor], backend: str) -> Rendering:
    height, width = scene["alpha"].shape
    gaussians = [scene[name] for name in _INPUTS]
    return rasterize(*gaussians, scene["viewmat"], scene["intrinsics"], width, height, backend=backend)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("name", ["smooth", "crowded"])
def test_pictures(name: str, backend: str) -> None:
    scene = load_file(FOLDER / f"{name}.safetensors")
    picture = _render(scene, backend)
    for field in ("features", "alpha", "depth"):
        assert scene[field].abs().max() > 0.5
        torch.testing.assert_close(getattr(picture, field), scene[field], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_gradients(backend: str) -> None:
    scene = load_file(FOLDER / "smooth.safetensors")
    variables = {name: scene[name].clone().requires_grad_() for name in _INPUTS}
    (_render({**scene, **variables}, backend).features * scene["weights"]).sum().backward()
    for name, variable in variables.items():
        expected = scene[f"gradient.{name}"]
        assert expected.abs().max() > 0.1
        torch.testing.assert_close(
            variable.grad, expected, atol=1e-4 * float(expected.abs().max()), rtol=1e-4
        )


def test_the_crowded_scene_reaches_the_cut_offs() -> None:
    scene = load_file(FOLDER / "crowded.safetensors")
    assert scene["alpha"].max() > 0.999 and (scene["alpha"] < 0.5).any()
