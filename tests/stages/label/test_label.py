"""gw label on a dressed person with known labels: without strokes, with strokes, and what the chain reads."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from stages.label import stage as label
from stages.label.config import LabelConfig, Stroke
from stages.label.strokes import read_strokes, stroke_labels
from stages.pipeline import REGISTER_TEMPLATE
from stages.register_template import stage as register_template
from stages.register_template.config import PRESETS as REGISTER
from stages.segment_layers import stage as segment_layers
from stages.shared.artifacts import Workspace
from stages.shared.body.model import BodyModel
from stages.shared.capture import Take
from stages.shared.capture.images import read_mask
from stages.shared.capture.subject import open_subject_capture
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.layers import LABEL_IDS, NO_LABEL
from stages.shared.meshes.raycast import RayScene
from tests.stages.dressed_body import LOWER, SKIN, UPPER, Dressed, dressed, write_capture

LAPEL = 5


@pytest.fixture(scope="module")
def person() -> Dressed:
    return dressed()


@pytest.fixture(scope="module")
def subject(person: Dressed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A registered subject whose capture has no label images and no scan."""
    folder = tmp_path_factory.mktemp("unlabelled")
    capture = write_capture(folder / "capture", person)
    shutil.rmtree(capture / "takes" / "walk" / "labels")
    register_template.run(capture, folder / "subject", REGISTER["tiny"])
    return folder / "subject"


def labelled_images(subject: Path, config: LabelConfig = LabelConfig()) -> dict[str, np.ndarray]:
    """The label images that a run writes, by camera."""
    artifact = label.run(subject, config).artifact
    return {path.parent.name: read_mask(path) for path in artifact.path.glob("images/*/*/*.png")}


def true_labels(person: Dressed, take: Take, camera: str) -> np.ndarray:
    assert person.mesh.labels is not None
    hits = RayScene(person.mesh.vertices, person.mesh.faces).render(take.camera(camera))
    return hits.largest_corner(person.mesh.faces, person.mesh.labels, NO_LABEL)


def mean_iou(person: Dressed, subject: Path, images: dict[str, np.ndarray]) -> float:
    take = template_take(subject)
    confusion = np.zeros((256, 256))
    for camera, image in images.items():
        np.add.at(confusion, (true_labels(person, take, camera), image), 1)
    ious = [
        confusion[i, i] / (confusion[i].sum() + confusion[:, i].sum() - confusion[i, i])
        for i in LABEL_IDS
        if confusion[i].sum()
    ]
    return float(np.mean(ious))


def template_take(subject: Path) -> Take:
    registered = Workspace(subject).require(REGISTER_TEMPLATE)
    body = BodyModel.from_arrays(registered.arrays("body"))
    return open_subject_capture(Workspace(subject), body).take("walk")


def test_a_person_without_labels_is_labelled(person: Dressed, subject: Path) -> None:
    images = labelled_images(subject)
    assert set(images) == set(template_take(subject).training_cameras)
    assert mean_iou(person, subject, images) > 0.85


def test_the_stages_that_follow_read_the_labels(person: Dressed, subject: Path) -> None:
    images = labelled_images(subject)
    take = template_take(subject)
    frame = int(Workspace(subject).require(REGISTER_TEMPLATE).summary["frame"])
    for camera, image in images.items():
        np.testing.assert_array_equal(take.labels(camera, frame), image)
    assert take.labels(take.training_cameras[0], 1 - frame) is None
    assert label.run(subject).artifact.key == label.run(subject).artifact.key


def test_labels_of_another_capture_are_forgotten(person: Dressed, subject: Path, tmp_path: Path) -> None:
    copy = tmp_path / "subject"
    label.run(subject)
    shutil.copytree(subject, copy)
    other = write_capture(tmp_path / "other", person)
    register_template.run(other, copy, REGISTER["tiny"])
    assert Workspace(copy).settings()["labels"] == ""


def test_a_stroke_decides_where_it_is_and_teaches_a_label_that_nobody_guesses(
    person: Dressed, subject: Path
) -> None:
    """An outer garment is never guessed; a stroke over the chest makes the shirt one."""
    take = template_take(subject)
    camera = take.training_cameras[0]
    truth = true_labels(person, take, camera)
    rows, columns = np.nonzero(truth == UPPER)
    points = ((float(columns.mean()) + 0.5, float(rows.mean()) + 0.5),)
    before = labelled_images(subject)[camera]
    image = labelled_images(subject, LabelConfig(strokes=(Stroke(LAPEL, points, 4.0, camera),)))[camera]
    row, column = int(points[0][1]), int(points[0][0])
    assert before[row, column] == UPPER and image[row, column] == LAPEL
    assert (image[truth == LOWER] == LOWER).mean() > 0.9


def test_strokes_cover_visible_vertices_only(subject: Path) -> None:
    registered = Workspace(subject).require(REGISTER_TEMPLATE)
    take = template_take(subject)
    surface = label._surface(registered, take, int(registered.summary["frame"]), LabelConfig())
    scene = RayScene(surface.vertices, surface.faces)
    camera = take.camera(take.training_cameras[0])
    middle = tuple(camera.project(surface.vertices.mean(axis=0))[0].tolist())
    stroke = Stroke(UPPER, (middle,), 10.0, camera.name)
    drawn = stroke_labels([stroke], surface.vertices, surface.normals, scene, take) == UPPER
    towards = camera.centre - surface.vertices
    assert drawn.any()
    assert (np.einsum("vk,vk->v", surface.normals, towards)[drawn] > 0).all()
    on_surface = Stroke(SKIN, (tuple(surface.vertices[7].tolist()),), 0.001)
    drawn = stroke_labels([on_surface], surface.vertices, surface.normals, scene, take) == SKIN
    assert drawn[7] and drawn.sum() < 5


def test_strokes_that_miss_are_refused(subject: Path) -> None:
    for stroke, error in (
        (Stroke(UPPER, ((1.0, 1.0),), 1.0, "cam0"), (BadData, UsageProblem)),
        (Stroke(UPPER, ((1.0, 1.0),), 1.0, "nobody"), (UsageProblem,)),
        (Stroke(UPPER, ((9.0, 9.0, 9.0),), 0.01), (BadData,)),
    ):
        with pytest.raises(error):
            label.run(subject, LabelConfig(strokes=(stroke,)))


def test_strokes_are_replayed_from_json(subject: Path, tmp_path: Path) -> None:
    stroke = {"label": "upper", "view": "cam0", "points": [[10.5, 20], [12, 22]], "radius": 3}
    path = tmp_path / "strokes.json"
    path.write_text(json.dumps({"format": "gw-strokes", "version": 1, "strokes": [stroke]}))
    assert read_strokes(path) == (Stroke(UPPER, ((10.5, 20.0), (12.0, 22.0)), 3.0, "cam0"),)


@pytest.mark.parametrize(
    "change",
    [
        {"label": "sock"},
        {"points": [[1, 2, 3]]},
        {"points": []},
        {"radius": 0},
        {"radius": None},
        {"view": 3},
        {"points": [["a", "b"]]},
    ],
)
def test_damaged_strokes_are_refused_with_their_place(change: dict[str, object], tmp_path: Path) -> None:
    stroke = {"label": "upper", "view": "cam0", "points": [[10, 20]], "radius": 3} | change
    path = tmp_path / "strokes.json"
    path.write_text(json.dumps({"format": "gw-strokes", "version": 1, "strokes": [stroke]}))
    with pytest.raises(BadData, match=r"strokes\[0\]"):
        read_strokes(path)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(BadData, match="stroke file"):
        read_strokes(tmp_path / "a.json")


def test_without_labels_the_next_stage_names_the_command(person: Dressed, tmp_path: Path) -> None:
    from stages.canonicalize import stage as canonicalize
    from stages.canonicalize.config import PRESETS as CANONICALIZE

    capture = write_capture(tmp_path / "capture", person)
    shutil.rmtree(capture / "takes" / "walk" / "labels")
    for scan in (capture / "takes" / "walk").glob("scan*"):
        scan.unlink()
    config = REGISTER["tiny"]
    register_template.run(capture, tmp_path / "subject", config)
    canonicalize.run(tmp_path / "subject", CANONICALIZE["tiny"])
    with pytest.raises(MissingInput, match="gw label"):
        segment_layers.run(tmp_path / "subject")
    label.run(tmp_path / "subject")
    assert segment_layers.run(tmp_path / "subject").summary["layers"] == ["body", "lower", "upper"]
