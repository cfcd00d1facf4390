"""Registration of one mesh of a dressed person, with a given body fit or without."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.register_template.config import RegisterTemplateConfig
from stages.register_template.fitting.fit_scan import UP_AXES, fit_scan
from stages.register_template.scan_cleaning import clean_scan, two_people
from stages.register_template.sources import Registration, Source
from stages.register_template.surface import MEDIAN_BAR_M, distances, turned_upright
from stages.shared.body import BodyModel
from stages.shared.body.convert import turned_poses
from stages.shared.body.posed import posed_body
from stages.shared.capture.convention import AS_IS
from stages.shared.errors import BadData, UsageProblem
from stages.shared.meshes.load import load_centred_mesh, load_mesh
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.picture import two_sided_picture
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import face_normals
from stages.shared.poses import load_poses
from stages.shared.report import Report

_STRANGE_M, _STRANGE_SHARE = 0.30, 0.25  # a mesh with more of its area this far from the body is refused


def register_mesh(source: Source, config: RegisterTemplateConfig, report: Report) -> Registration:
    """Take a lone mesh as the template; fit the body when no parameters are given.

    Raises:
        BadData: not the size of a person, two people, a mesh far from its body.
        UsageProblem: a frame that the pose file does not have.
    """
    assert source.mesh is not None
    body, where = source.body, str(source.mesh)
    scan, middle = (
        load_centred_mesh(source.mesh) if source.params is None else (load_mesh(source.mesh), np.zeros(3))
    )
    if middle.any():
        report.warn(f"the scan is far from the origin, around {middle.tolist()}; it is moved to the origin")
    cleaned = clean_scan(scan, config.most_faces, where, report)
    mesh = cleaned.mesh
    if source.params is None:
        report.step("fitting the body to the mesh")
        fit = fit_scan(body, mesh, report, config.effort)
        poses, frame = fit.state.poses(), 0
        turn = UP_AXES[fit.up]
        if fit.up != "+y":
            report.warn(f"{fit.up} is up in the mesh; it is turned so that +y is")
            mesh = replace(mesh, vertices=(mesh.vertices @ turn.T).astype(np.float32))
            poses = turned_poses(body, poses, turn)
        how: dict[str, Any] = {"parameters": "fitted", "up": fit.up, "loss": fit.loss, "turn": turn.tolist()}
        refuse_strangers(body, posed_body(body, poses), mesh, where)
    else:
        poses, frame = load_poses(source.params, body, one_person=True, report=report), source.frame or 0
        if frame >= len(poses):
            raise UsageProblem(
                f"The pose file has {len(poses)} frames; there is no frame {frame}.",
                "option --frame",
                f"Choose 0 to {len(poses) - 1}.",
            )
        mesh, up = turned_upright(mesh, posed_body(body, poses[frame]), report)
        how = {"parameters": "given", "up": up}
    posed = posed_body(body, poses[frame])
    numbers = distances(mesh, posed, body)
    if numbers["template_to_body_m"] > MEDIAN_BAR_M:
        raise BadData(
            f"Half of the mesh is farther than {100 * numbers['template_to_body_m']:.0f} cm from the body.",
            f"{source.mesh}, {source.params or 'fitted body'}",
            "Check that mesh and parameters are of the same frame and in metres, y up."
            if source.params
            else "Give the fit of the body with --params; this mesh could not be fitted.",
        )
    content = {"convention": AS_IS, "template": cleaned.report | how, **numbers}
    return Registration(mesh, poses, frame, None, {}, _picture(mesh, posed, body), content, numbers)


def refuse_strangers(body: BodyModel, posed: NDArray[np.float64], mesh: Mesh, where: str) -> None:
    """Raise BadData when much of a mesh is far from the fitted body: two people who touch, or furniture."""
    areas = face_normals(mesh.vertices, mesh.faces)[1]
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    far = RayScene(posed, body.faces).distance(middles) > _STRANGE_M
    share = float(areas[far].sum() / areas.sum())
    if share > _STRANGE_SHARE:
        raise two_people(
            where, f"{100 * share:.0f} % of the surface is {_STRANGE_M:g} m from the body or more"
        )


def _picture(mesh: Mesh, posed: NDArray[np.float64], body: BodyModel) -> NDArray[np.uint8]:
    """The mesh above the fitted body."""
    pictures = [
        two_sided_picture(mesh.vertices, mesh.faces, mesh.colors),
        two_sided_picture(posed, body.faces),
    ]
    width = max(picture.shape[1] for picture in pictures)
    return np.concatenate(
        [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in pictures]
    )
