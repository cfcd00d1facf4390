"""Other renderers of the same scene, to compare with."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.shared.errors import MissingInput
from stages.shared.splat import cuda, reference
from stages.shared.splat.gaussians import Rendering
from tests.benchmarks.splat.figure import Figure


def gsplat_torch(
    figure: Figure, view: Tensor, intrinsics: Tensor, width: int, height: int, background: Tensor
) -> Rendering:
    """gsplat's projection in torch, and the accumulation of our reference.

    gsplat's own accumulation needs its CUDA kernels to find out which pixels a Gaussian meets.
    """
    camera = (view, intrinsics, width, height)
    centers, conics, depths = cuda.torch_projection(figure.means, figure.quats, figure.scales, *camera)
    seen = (depths > 0.01).nonzero()[:, 0]
    index = seen[torch.argsort(depths[seen], stable=True)]
    placed = reference.Projected(index, centers[index], conics[index], depths[index], figure.opacities[index])
    return reference.render(placed, figure.colors, background, width, height)


def why_no_gsplat() -> str | None:
    """Why `gsplat_torch` cannot run here, or None."""
    one = Figure(torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3))
    try:
        gsplat_torch(one, torch.eye(4), torch.eye(3), 1, 1, torch.zeros(3))
    except MissingInput as problem:
        return problem.what
    return None
