"""Where a viewer's camera stands at first: as an orbit around the person, in `OrbitCamera`'s numbers."""

from __future__ import annotations

from importlib import resources

import numpy as np

from stages.shared.capture.camera import Camera
from stages.shared.splat.gaussians import Gaussians


def orbit_start(camera: Camera, composite: Gaussians) -> dict[str, object]:
    """Target, distance (m), azimuth from +z towards +x, tilt (rad), field of view (degrees, longer side).

    The eye is that of `camera`; it looks at the middle of the Gaussians.
    """
    means = composite.means.double().numpy()
    low, high = np.percentile(means, [1, 99], axis=0) if len(means) else (np.zeros(3), np.zeros(3))
    target = (low + high) / 2
    away = camera.centre - target
    distance = max(float(np.linalg.norm(away)), 1e-3)
    longer = max(camera.width, camera.height)
    return {
        "target": target.round(6).tolist(),
        "azimuth": round(float(np.arctan2(away[0], away[2])), 6),
        "tilt": round(float(np.arcsin(np.clip(away[1] / distance, -1, 1))), 6),
        "distance": round(distance, 6),
        "fieldOfView": round(float(np.rad2deg(2 * np.arctan(0.5 * longer / camera.intrinsics[0, 0]))), 6),
    }


def viewer_script(name: str = "viewer.js") -> str:
    """The text of viewer.js, which draws, or of clip.js, which plays a motion with it."""
    return resources.files("stages.shared.web").joinpath(name).read_text("utf-8")
