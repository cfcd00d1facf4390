"""Hulls next to a body: limbs that one of few masks has lost, and skirts, which no leg shows through."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from stages.register_template.fitting.body_parts import parts_far_from
from stages.register_template.hull import carve
from stages.register_template.hull_rounding import PARTS, parts_of
from stages.shared.body import embedded_body
from stages.shared.body.posed import posed_body
from stages.shared.capture import open_capture
from stages.shared.meshes.raycast import RayScene
from stages.shared.report import SILENT

from .scenes import a_pose, skirted_pose, skirted_surface, write_capture, write_skirted

BODY = embedded_body()


def test_a_limb_that_a_mask_of_few_has_lost_is_the_bodys(tmp_path: Path) -> None:
    """Moved masks of one of four cameras: no ghost is left, and no hand is missing."""
    folder = write_capture(tmp_path / "capture")
    file = folder / "takes" / "walk" / "masks" / "cam0" / "000001.png"
    mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    cv2.imwrite(str(file), np.roll(mask, 3, axis=1))  # pixels: four centimetres
    take = replace(open_capture(folder).takes[0], training_cameras=("cam0", "cam1", "cam3", "cam4"))
    posed = posed_body(BODY, a_pose()[1])
    plain = carve(take, 1, posed, 0.02, 0.35, SILENT)
    mended = carve(take, 1, posed, 0.02, 0.35, SILENT, BODY.faces, parts_of(BODY))
    away = [RayScene(posed, BODY.faces).distance(mesh.vertices).mean() for mesh in (plain, mended)]
    assert away[1] < 0.02 and away[1] < 0.7 * away[0]
    assert parts_far_from(mended, posed, BODY) == []


def test_a_wide_skirt_keeps_its_shape_and_has_no_caves(tmp_path: Path) -> None:
    poses = skirted_pose((1.45,))
    take = open_capture(write_skirted(tmp_path / "capture", poses), poses_needed=False).takes[0]
    posed = posed_body(BODY, poses[0])
    mesh = carve(take, 0, posed, 0.015, 0.35, SILENT, BODY.faces, parts_of(BODY))
    away = RayScene(*skirted_surface(posed)).distance(mesh.vertices)
    assert np.quantile(away, 0.9) < 0.042  # metres; 0.047 where the thickness of a leg cuts the skirt


def test_every_joint_is_in_one_part() -> None:
    parts = parts_of(BODY)
    assert set(parts) == set(range(len(PARTS)))
    names = [name for part in PARTS for name in part]
    assert len(names) == len(set(names))
