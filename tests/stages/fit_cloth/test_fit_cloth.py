"""gw fit-cloth: openings, pins, outlines, and the whole stage on a tiny subject."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.fit_cloth import stage
from stages.fit_cloth.choice import Agreement, best_material, default_driver
from stages.fit_cloth.config import FitClothConfig
from stages.fit_cloth.mesh import pins, with_material, without_loose_pieces
from stages.fit_cloth.openings import close_holes, highest_rim, rims
from stages.fit_cloth.outlines import Outlines, outline_view
from stages.fit_cloth.welding import large_pieces, weld
from stages.shared.artifacts import Workspace
from stages.shared.body import embedded_body
from stages.shared.cloth.material import TIGHT, Material
from stages.shared.cloth.pattern import ClothPattern
from stages.shared.errors import UsageProblem
from stages.shared.layers import NO_LABEL, REGIONS, SKIN
from stages.shared.meshes import RayScene
from stages.shared.outfit.trained_subject import TrainedSubject, fitted_cloth
from tests.shared.outfit.wardrobe import cameras, make_subject

LOWER, OUTER = REGIONS["lower"][0], REGIONS["outer"][0]
TINY = FitClothConfig(vertices=60, frames=4, detail=0.1, materials=("tight", "flared"))


def tube(around: int = 24, rows: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """An open tube about the pelvis, upright: vertices (V, 3), faces."""
    angle, height = np.meshgrid(
        np.arange(around) * 2 * np.pi / around, np.linspace(-0.3, 0.1, rows), indexing="ij"
    )
    vertices = np.stack([0.2 * np.cos(angle), height, 0.2 * np.sin(angle)], axis=-1).reshape(-1, 3)
    faces = []
    for i in range(around):
        for j in range(rows - 1):
            a, b = i * rows + j, (i + 1) % around * rows + j
            faces += [[a, a + 1, b], [b, a + 1, b + 1]]
    return vertices, np.array(faces, np.int32)


def test_holes_are_closed_and_openings_for_limbs_stay() -> None:
    vertices, faces = tube()
    joints = embedded_body().joint_template
    torn = np.delete(faces, [50, 51, 52, 53], axis=0)
    assert len(rims(torn, len(vertices))) == 3
    closed, whole = close_holes(vertices, torn, joints)
    assert len(rims(whole, len(closed))) == 2
    heights = [closed[rim[:, 0], 1].mean() for rim in rims(whole, len(closed))]
    np.testing.assert_allclose(sorted(heights), [-0.3, 0.1], atol=1e-6)
    np.testing.assert_allclose(closed[highest_rim(closed, whole), 1], 0.1)


def test_pins_follow_the_rule() -> None:
    vertices, faces = tube()
    joints = embedded_body().joint_template
    waist = pins("lower", vertices, faces, joints)
    assert waist.any() and (vertices[waist, 1] > 0.1 - 0.035).all()
    assert not pins("upper", vertices, faces, joints).any()
    dress = vertices * [1, 2, 1] + [0, 0.5, 0]
    assert not pins("lower", dress, faces, joints).any()
    jacket = vertices + [0, joints[12, 1] - 0.1, 0]
    collar = pins("outer", jacket, faces, joints)
    assert collar.any() and (jacket[collar, 2] < joints[12, 2]).all()


def label_image(scene: RayScene, label: int) -> np.ndarray:
    """What a camera sees of a mesh: its label, and none elsewhere."""
    return np.where(scene.render(cameras()[0]).hit, label, NO_LABEL).astype(np.uint8)


def test_outlines_tell_how_far_a_garment_is_from_its_place() -> None:
    vertices, faces = tube(60, 40)
    places = 0.3 * vertices
    labels = label_image(RayScene(places, faces), LOWER)
    body = RayScene(places * [0.5, 0.9, 0.5], faces)
    view = outline_view(cameras()[0], labels, "lower", 0.001, body)
    assert 20 < view.garment.sum() < view.garment.size
    outlines = Outlines({0: [view]}, faces)
    wrong = [outlines.disagreement(0, places + [shift, 0, 0]) for shift in (0.0, 0.02, 0.05)]
    assert wrong[0] == 0 and wrong[0] < wrong[1] < wrong[2] <= 1


def test_a_garment_behind_the_body_is_not_in_its_outline() -> None:
    vertices, faces = tube(60, 40)
    places, body = 0.3 * vertices, 0.25 * vertices
    labels = label_image(RayScene(places, faces), LOWER)
    outlines = Outlines(
        {0: [outline_view(cameras()[0], labels, "lower", 0.001, RayScene(body, faces))]}, faces
    )
    assert outlines.disagreement(0, places) == 0
    assert outlines.disagreement(0, 0.15 * vertices) == 1  # the body hides all of it


def test_a_garment_may_hide_what_is_worn_over_it_but_nothing_beneath() -> None:
    vertices, faces = tube(60, 40)
    places = 0.3 * vertices
    body = RayScene(0.1 * vertices, faces)
    wrong = {}
    for name, label in (("skin", SKIN), ("outer", OUTER)):
        labels = label_image(RayScene(places, faces), label)
        labels[: len(labels) // 2][labels[: len(labels) // 2] != NO_LABEL] = LOWER
        view = outline_view(cameras()[0], labels, "lower", 0.001, body)
        wrong[name] = Outlines({0: [view]}, faces).disagreement(0, places)
    assert wrong["outer"] == 0 < wrong["skin"] < 1


def test_the_stage_fits_every_garment_and_the_subject_uses_it(tmp_path: Path) -> None:
    subject = make_subject(tmp_path)
    result = stage.run(subject, TINY)
    for name in ("lower", "upper"):
        figures = result.summary[name]
        assert set(figures["materials"]) == {"tight", "flared"}
        assert figures["drive"] in figures["drivers"] and figures["vertices"] > 20
        agreement = figures["drivers"]["simulated"]
        assert 0 <= agreement["outline"] <= 1 and np.isfinite(agreement["tracked_m"])
    assert fitted_cloth(Workspace(subject)) is not None
    outfit = TrainedSubject.open(subject).outfit()
    assert [layer.cloth is not None for layer in outfit.layers] == [False, True, True]
    again = stage.run(subject, TINY)
    assert again.artifact.key == result.artifact.key
    assert stage.plan(subject, TINY).seconds > 0


def test_an_unknown_material_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageProblem, match="velvet"):
        stage.run(tmp_path, FitClothConfig(materials=("velvet",)))


def test_an_edge_of_almost_no_length_gets_a_rest_length_that_bundles_allow() -> None:
    """Remeshing may leave two vertices in nearly the same place."""
    corners = np.array([[0, 0, 0], [1e-6, 0, 0], [0.03, 0, 0], [0, 0.03, 0]], np.float32)
    faces = np.array([[0, 2, 3], [0, 1, 2]], np.int32)
    nothing = np.zeros((4, 3), np.float32)
    pattern = ClothPattern(
        vertices=corners, rest_vertices=corners, rest_lengths=np.zeros(5, np.float32), faces=faces,
        pinned=np.zeros(4, np.int32), skin_margin=np.zeros(4, np.float32),
        skin_weights=np.zeros((4, 55), np.float32), shape_directions=np.zeros((4, 10, 3), np.float32),
        pose=np.zeros((55, 3), np.float32), texel_faces=np.zeros(4, np.int32),
        texel_weights=nothing, texel_offsets=nothing, material=TIGHT, betas=np.zeros(10, np.float32),
    )  # fmt: skip
    fitted = with_material(pattern, Material(), None, None)  # type: ignore[arg-type]  # a body is for balance alone
    lengths = np.sort(fitted.rest_lengths)
    assert lengths[0] == np.float32(1e-3)
    np.testing.assert_allclose(lengths[1:], np.sort([0.03, 0.03, 0.03 - 1e-6, 0.03 * 2**0.5]), rtol=1e-5)


def test_a_loose_piece_is_left_out_and_large_pieces_stay() -> None:
    """A scrap of cloth that hangs on nothing would fall out of the picture."""
    row = np.arange(30)
    strip = np.concatenate(
        [np.stack([row, np.zeros(30), np.zeros(30)], 1), np.stack([row, np.ones(30), np.zeros(30)], 1)]
    )
    first = np.arange(29)
    faces = np.concatenate(
        [np.stack([first, first + 1, first + 30], 1), np.stack([first + 1, first + 31, first + 30], 1)]
    )
    scrap = np.array([[0.0, -5, 0], [1, -5, 0], [0, -6, 0]])
    vertices = np.concatenate([scrap, strip, strip + [0, 9, 0]])
    triangles = np.concatenate([[[0, 1, 2]], faces + 3, faces + 63])
    kept, kept_faces = without_loose_pieces(vertices, triangles, np.zeros(len(vertices), bool))
    np.testing.assert_array_equal(kept, vertices[3:])
    np.testing.assert_array_equal(kept_faces, triangles[1:] - 3)
    pinned = np.arange(len(vertices)) == 4  # in the first strip: the second one would fall
    assert len(without_loose_pieces(vertices, triangles, pinned)[0]) == 60


def agreement(*samples: float) -> Agreement:
    return Agreement(0.02, float(np.mean(samples)), np.array(samples))


ONE_PIECE = (np.array([[0, 1, 2], [1, 3, 2]], np.int32), 4)


def test_a_mesh_in_pieces_is_not_simulated_by_default() -> None:
    drivers = {
        "bones": agreement(0.2, 0.2),
        "simulated": agreement(0.1, 0.1),
        "learned": agreement(0.15, 0.15),
    }
    assert default_driver(drivers, *ONE_PIECE) == "simulated"
    assert default_driver(drivers, np.array([[0, 1, 2], [3, 4, 5]], np.int32), 6) == "learned"


def test_another_driver_than_simulation_must_be_significantly_better() -> None:
    noisy = {"simulated": agreement(0.11, 0.20, 0.14), "learned": agreement(0.15, 0.13, 0.14)}
    steady = {"simulated": agreement(0.15, 0.20, 0.16), "learned": agreement(0.13, 0.18, 0.14)}
    assert default_driver(noisy, *ONE_PIECE) == "simulated"
    assert default_driver(steady, *ONE_PIECE) == "learned"


def test_pieces_are_welded_to_one_sheet_and_openings_stay() -> None:
    vertices, faces = tube(48, 24)
    height = vertices[faces][:, :, 1].mean(axis=1)
    apart = faces[(height < -0.12) | (height > -0.09)]  # a gap of three to five centimetres around
    assert len(large_pieces(apart, len(vertices))) == 2
    whole, triangles = weld(vertices, apart, edge=0.03)
    assert len(large_pieces(triangles, len(whole))) == 1
    sides = [rim for rim in rims(triangles, len(whole)) if len(rim) > 20]
    heights = sorted(whole[rim[:, 0], 1].mean() for rim in sides)
    np.testing.assert_allclose(heights, [-0.3, 0.1], atol=0.015)
    np.testing.assert_allclose(np.linalg.norm(whole[:, [0, 2]], axis=1), 0.2, atol=0.012)


def test_a_garment_in_one_piece_is_not_welded() -> None:
    vertices, faces = tube()
    assert weld(vertices, faces, edge=0.03)[0] is vertices


def test_pieces_far_apart_stay_apart() -> None:
    vertices, faces = tube(48, 24)
    height = vertices[faces][:, :, 1].mean(axis=1)
    apart = faces[(height < -0.18) | (height > -0.03)]
    whole, triangles = weld(vertices, apart, edge=0.03)
    assert len(large_pieces(triangles, len(whole))) == 2


def test_the_tracked_offsets_decide_between_outlines_that_are_equally_good() -> None:
    noise = np.array([0.01, -0.01, 0.02, -0.02])
    trials = {
        "best outline": Agreement(0.03, 0.20, 0.20 + noise),
        "as good": Agreement(0.01, 0.201, 0.201 - noise),
        "worse": Agreement(0.005, 0.25, 0.25 + noise),
    }
    assert best_material(trials)[0] == "as good"
    without = {name: Agreement(trial.tracked, None, trial.samples) for name, trial in trials.items()}
    assert best_material({"one": without["best outline"]})[0] == "one"
