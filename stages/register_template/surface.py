"""The surface of the dressed person at the template's frame: scan, hull or bare body."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.fitting.fit_scan import UP_AXES
from stages.register_template.hull import carve, largest_part, smooth
from stages.register_template.hull_rounding import parts_of
from stages.register_template.scan_cleaning import clean_scan
from stages.shared.body import BodyModel
from stages.shared.capture import Take
from stages.shared.capture.projection import project_colors
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.remesh import remesh
from stages.shared.meshes.topology import vertex_normals
from stages.shared.report import Report

# A template with a larger median distance from the body belongs to another frame, place or unit.
MEDIAN_BAR_M = 0.15
_COMPARED = 3000  # vertices that are looked at to find the up axis


def make_surface(
    kind: str,
    take: Take,
    frame: int,
    posed: NDArray[np.float64],
    body: BodyModel,
    config: RegisterTemplateConfig,
    report: Report,
) -> tuple[Mesh, dict[str, Any]]:
    """The surface of the dressed person at one frame, world, metres, and how it was made.

    Arguments:
        kind: "scan", "hull" or "body".
        posed: (V, 3) the body at that frame.

    Raises:
        BadData: a scan that does not fit the body, masks without a common volume.
    """
    if kind == "body":
        report.step("taking the body model as the template")
        mesh = Mesh(posed.astype(np.float32), body.faces)
        how: dict[str, Any] = {"made": "body model"}
    elif kind == "scan":
        report.step("reading the scan")
        scan = take.read_scan()
        assert scan is not None
        cleaned = clean_scan(scan, config.most_faces, str(take.scan), report)
        mesh, up = turned_upright(cleaned.mesh, posed, report)
        _check_scan(mesh, posed, take)
        return mesh, {"made": "scan", "up": up, **cleaned.report}
    else:
        report.step("carving the hull of the masks")
        faces = body.faces if config.hull_rounded else None
        parts = parts_of(body)
        carved = carve(take, frame, posed, config.hull_pitch_m, config.hull_reach_m, report, faces, parts)
        even, method = remesh(smooth(carved, config.smoothing_steps), config.edge_m)
        mesh = largest_part(even)
        how = {"made": "hull", "carved_vertices": len(carved.vertices), "remeshed": method}
    return _colored(mesh, take, frame), how


def _colored(mesh: Mesh, take: Take, frame: int) -> Mesh:
    """The mesh with colours from the pictures; an unseen vertex takes the colour of the nearest seen one."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    colors, confidence = project_colors(
        mesh.vertices, normals, RayScene(mesh.vertices, mesh.faces), take, frame
    )
    unseen = confidence <= 0
    if unseen.any() and not unseen.all():
        nearest = cKDTree(mesh.vertices[~unseen]).query(mesh.vertices[unseen])[1]
        colors[unseen] = colors[~unseen][nearest]
    return Mesh(mesh.vertices, mesh.faces, np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8))


def _check_scan(mesh: Mesh, posed: NDArray[np.float64], take: Take) -> None:
    distance = float(np.median(cKDTree(posed).query(mesh.vertices)[0]))
    if distance > MEDIAN_BAR_M:
        raise BadData(
            f"Half of the scan is farther than {100 * distance:.0f} cm from the body.",
            f"{take.scan}, frame {take.scan_frame}",
            "Check that scan and poses are of the same frame and in metres, or choose --template hull.",
        )


def turned_upright(mesh: Mesh, posed: NDArray[np.float64], report: Report) -> tuple[Mesh, str]:
    """The mesh turned so that its up axis is the body's, and which axis was up.

    A scan in another axis convention than its poses lies far from the body until it is turned about the
    world's origin. A mesh that no turn brings near is not changed.
    """
    tree = cKDTree(posed)
    some = mesh.vertices[:: max(1, len(mesh.vertices) // _COMPARED)]
    away = {up: float(np.median(tree.query(some @ turn.T)[0])) for up, turn in UP_AXES.items()}
    up = min(away, key=lambda name: away[name])
    if up == "+y" or away["+y"] <= MEDIAN_BAR_M or away[up] > MEDIAN_BAR_M:
        return mesh, "+y"
    report.warn(f"{up} is up in the scan, and +y in the poses; the scan is turned")
    return replace(mesh, vertices=(mesh.vertices @ UP_AXES[up].T).astype(np.float32)), up


def distances(template: Mesh, posed: NDArray[np.float64], body: BodyModel) -> dict[str, Any]:
    """Distances between template and body, both ways, metres: median, mean and 95th percentile."""
    ways = {
        "template_to_body": RayScene(posed, body.faces).distance(template.vertices),
        "body_to_template": RayScene(template.vertices, template.faces).distance(posed),
    }
    numbers: dict[str, Any] = {}
    for name, values in ways.items():
        numbers[f"{name}_m"] = float(np.median(values))
        numbers[f"{name}_mean_m"] = float(values.mean())
        numbers[f"{name}_p95_m"] = float(np.percentile(values, 95))
    return numbers
