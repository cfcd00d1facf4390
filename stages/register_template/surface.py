"""The surface of the dressed person at the template's frame: scan, hull or bare body."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.hull import carve, largest_part, smooth
from stages.shared.body import BodyModel
from stages.shared.capture import Take
from stages.shared.capture.projection import project_colors
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.remesh import remesh, simplify
from stages.shared.meshes.topology import vertex_normals
from stages.shared.report import Report

# A template farther than this from the body (median of its vertices) is of another frame, place or unit.
MEDIAN_BAR_M = 0.15


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
        mesh, way = simplify(scan, config.most_faces)
        _check_scan(mesh, posed, take)
        return mesh, {"made": "scan", "simplified": way}
    else:
        report.step("carving the hull of the masks")
        carved = carve(take, frame, posed, config.hull_pitch_m, config.hull_reach_m, report)
        even, way = remesh(smooth(carved, config.smoothing_steps), config.edge_m)
        mesh = largest_part(even)
        how = {"made": "hull", "carved_vertices": len(carved.vertices), "remeshed": way}
    return _colored(mesh, take, frame), how


def _colored(mesh: Mesh, take: Take, frame: int) -> Mesh:
    """The mesh with the colours that the cameras see; unseen vertices take the nearest seen one's."""
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


def distances(template: Mesh, posed: NDArray[np.float64], body: BodyModel) -> dict[str, Any]:
    """Median distance between template and body, both ways, metres."""
    to_body = RayScene(posed, body.faces).distance(template.vertices)
    to_template = RayScene(template.vertices, template.faces).distance(posed)
    return {
        "template_to_body_m": float(np.median(to_body)),
        "body_to_template_m": float(np.median(to_template)),
    }
