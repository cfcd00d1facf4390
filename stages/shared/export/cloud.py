"""Converts covariances to rotations and scales, which every splat format stores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.splat.gaussians import Gaussians
from stages.shared.splat.ply import SplatCloud

SMALLEST_SCALE = 1e-6  # m; what the 3DGS layout keeps apart from zero


def cloud_of(composite: Gaussians) -> SplatCloud:
    """All Gaussians; `layers` has the index of the layer of each.

    Skinning shears a Gaussian, so that no rotation and scale of the canonical one describe it; the principal
    axes of its covariance do, exactly. Scales come largest first.
    """
    quats, scales = principal_axes(composite.covariances.double().numpy())
    return SplatCloud(
        means=composite.means.float().numpy(),
        quats=quats,
        scales=scales,
        opacities=composite.opacities.float().numpy(),
        colors=composite.features[:, :3].float().numpy(),
        layers=composite.layer_ids.numpy().astype(np.uint8),
    )


def turned_over(cloud: SplatCloud) -> SplatCloud:
    """The cloud turned by 180 degrees about x: from y up and z towards the viewer to y down and z away.

    That is the convention of 3D Gaussian splatting (its cameras come from COLMAP), which viewers of .ply
    files expect; .spz and glTF have y up.
    """
    if cloud.harmonics is not None:
        raise ValueError("view-dependent colours are not turned")
    w, x, y, z = cloud.quats.T
    quats = np.column_stack([-x, w, -z, y])  # (0, 1, 0, 0) times the quaternion
    quats[quats[:, 0] < 0] *= -1
    return replace(cloud, means=cloud.means * np.array([1, -1, -1], np.float32), quats=quats)


def principal_axes(
    covariances: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unit quaternions (N, 4) wxyz with w ≥ 0, and standard deviations (N, 3) m, of covariances (N, 3, 3) m².

    Variances that rounding took below `SMALLEST_SCALE`² are raised to it.
    """
    if not len(covariances):
        return np.zeros((0, 4), np.float32), np.zeros((0, 3), np.float32)
    variances, axes = np.linalg.eigh(covariances)
    variances, axes = variances[:, ::-1], axes[:, :, ::-1].copy()
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    quats = Rotation.from_matrix(axes).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    scales = np.sqrt(np.maximum(variances, SMALLEST_SCALE**2))
    return quats.astype(np.float32), scales.astype(np.float32)
