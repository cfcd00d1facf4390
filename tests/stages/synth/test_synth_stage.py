"""`gw synth` end to end at the smallest size, read back the way any capture is read."""

from __future__ import annotations

import hashlib
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.artifacts import files
from stages.shared.body import embedded_body, posed_vertices
from stages.shared.capture import Take, open_capture
from stages.shared.capture.true_meshes import true_meshes_of
from stages.shared.errors import StorageFailure
from stages.shared.layers import NO_LABEL
from stages.shared.poses import load_poses
from stages.synth import stage
from stages.synth.config import PRESETS, SynthConfig

MICRO = SynthConfig(
    image_size=48,
    supersample=1,
    cameras=2,
    train_images=1,
    train_stride=2,
    test_images=1,
    test_stride=2,
    cloth_spacing=0.05,
    substeps=8,
    ambient_rays=4,
    jpeg=False,
)
GARMENTS = {
    ("subject_1", "train"): {"lower", "upper"},
    ("subject_2", "train"): {"lower", "upper", "outer"},
    ("tryon_truth", "held_out"): {"lower", "upper", "outer"},
    ("inner_truth", "inner"): {"lower", "upper"},
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> stage.SynthResult:
    return stage.run(tmp_path_factory.mktemp("synth"), PRESETS["tiny"])


def _take(made: stage.SynthResult, capture: str, name: str) -> Take:
    return next(take for take in open_capture(made.captures[capture]).takes if take.name == name)


def _posed(take: Take, frame: int) -> np.ndarray:
    poses, model = take.poses, embedded_body()
    return posed_vertices(
        model,
        torch.from_numpy(poses.rotations[frame]),
        torch.from_numpy(poses.translation[frame]),
        torch.from_numpy(poses.betas),
    ).numpy()


def test_a_disk_too_full_is_refused_before_anything_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "free_bytes", lambda path: 1000)
    with pytest.raises(StorageFailure, match="1000 bytes free"):
        stage.run(tmp_path / "captures", PRESETS["tiny"])
    assert not (tmp_path / "captures").exists()


def test_the_captures_have_the_takes_and_splits(made: stage.SynthResult) -> None:
    for name in ("subject_1", "subject_2"):
        capture = open_capture(made.captures[name])
        assert [(take.name, take.split) for take in capture.takes] == [
            ("train", "train"),
            ("held_out", "test"),
        ]
        assert capture.takes[0].frames == [0, 15, 30, 45]
        assert len(capture.takes[0].poses) == 60
        assert len(capture.takes[0].training_cameras) == 4
        assert len(capture.takes[0].heldout_cameras) == 1
    truth = open_capture(made.captures["tryon_truth"])
    assert [(take.name, take.split) for take in truth.takes] == [("held_out", "test")]


@pytest.mark.parametrize(("capture", "name"), GARMENTS)
def test_the_labels_show_the_garments_that_are_worn(made: stage.SynthResult, capture: str, name: str) -> None:
    take = _take(made, capture, name)
    seen: dict[int, int] = {}
    for camera in take.cameras:
        labels, mask = take.labels(camera, take.frames[0]), take.mask(camera, take.frames[0])
        assert labels is not None
        assert np.array_equal(labels != NO_LABEL, mask > 127)
        assert take.image(camera, take.frames[0])[mask == 0].mean() < 0.5  # black but for JPEG's ringing
        for label, count in zip(*np.unique(labels, return_counts=True), strict=True):
            seen[int(label)] = seen.get(int(label), 0) + int(count)
    expected = {0, 1, 2} | {{"upper": 3, "lower": 4, "outer": 5}[layer] for layer in GARMENTS[capture, name]}
    assert set(seen) == expected | {NO_LABEL}
    assert min(seen.values()) > 10


@pytest.mark.parametrize(("capture", "name"), GARMENTS)
def test_pictures_show_the_body_where_the_parameters_say(
    made: stage.SynthResult, capture: str, name: str
) -> None:
    take = _take(made, capture, name)
    frame = take.frames[-1]
    body = _posed(take, frame)
    _assert_aligned(take, frame, body)


def _assert_aligned(take: Take, frame: int, points: np.ndarray) -> None:
    """Points of the person fall into the masks, and a shift of less than a pixel fits worse."""

    def share(shift: tuple[float, float]) -> float:
        cameras = take.cameras.values()
        return float(
            np.mean([_share_inside(one.project(points)[0] + shift, take.mask(one, frame)) for one in cameras])
        )

    inside = share((0.0, 0.0))
    assert inside > 0.88
    assert inside > max(share((x, y)) for x in (-0.6, 0.0, 0.6) for y in (-0.6, 0.0, 0.6) if x or y)


def _share_inside(pixels: np.ndarray, mask: np.ndarray) -> float:
    column, row = np.floor(pixels).astype(int).T
    return float(mask[row, column].mean() / 255)


@pytest.mark.parametrize(("capture", "name"), GARMENTS)
def test_garments_do_not_tear_and_stay_outside_the_body(
    made: stage.SynthResult, capture: str, name: str
) -> None:
    take = _take(made, capture, name)
    with np.load(made.captures[capture] / "takes" / name / "gt" / "meshes.npz") as truth:
        assert truth["frames"].tolist() == take.frames
        for layer in GARMENTS[capture, name]:
            positions, faces, rest = truth[f"{layer}_v"], truth[f"{layer}_f"], truth[f"{layer}_rest"]
            assert np.isfinite(positions).all()
            one, two = faces.ravel(), faces[:, [1, 2, 0]].ravel()
            stretch = np.linalg.norm(positions[:, one] - positions[:, two], axis=-1)
            stretch /= np.linalg.norm(rest[one] - rest[two], axis=-1)
            assert np.percentile(stretch, 99) < 1.3
            assert stretch.max() < 2.5
            for index, frame in enumerate(take.frames):
                distance = igl.signed_distance(
                    positions[index].astype(np.float64),
                    _posed(take, frame).astype(np.float64),
                    embedded_body().faces.astype(np.int64),
                    sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
                )[0]
                # The body overlaps itself at the armpit of a lowered arm; cloth there cannot be outside.
                assert distance.min() > -0.02
                assert np.mean(distance < 0) < 0.01


def test_its_truth_is_what_evaluate_measures_against(made: stage.SynthResult) -> None:
    """Of each take, and cloth of the same numbers in both, so that points of it can be followed."""
    capture = open_capture(made.captures["subject_2"])
    found = true_meshes_of([str(capture.root)], capture)
    assert set(found) == {take.name for take in capture.takes} == {"train", "held_out"}
    for take in capture.takes:
        assert list(found[take.name].rows) == take.frames
        assert set(found[take.name].layers) == GARMENTS["subject_2", "train"]
    for layer, mesh in found["train"].layers.items():
        assert mesh.same_cloth(found["held_out"].layers[layer])


def test_cloth_lags_behind_the_body(made: stage.SynthResult) -> None:
    take = _take(made, "subject_1", "train")
    with np.load(made.captures["subject_1"] / "takes" / "train" / "gt" / "meshes.npz") as truth:
        skirt, rest = truth["lower_v"], truth["lower_rest"]
    hem = np.argsort(rest[:, 1])[:30]
    pelvis = take.poses.translation[take.frames]
    swing = (skirt[:, hem] - pelvis[:, None]).std(axis=0).max()
    assert 0.005 < swing < 0.4


def test_the_scan_is_the_first_frame_with_colours_and_labels(made: stage.SynthResult) -> None:
    take = _take(made, "subject_2", "train")
    scan = take.read_scan()
    assert scan is not None and take.scan_frame == 0
    assert scan.colors is not None and scan.labels is not None
    assert set(np.unique(scan.labels)) == {0, 1, 2, 3, 4, 5}
    outer = scan.colors[scan.labels == 5]
    assert len(np.unique(outer, axis=0)) >= 3  # the pattern, not one colour
    _assert_aligned(take, 0, scan.vertices)


def test_the_try_on_is_subject_2_in_the_skirt_of_subject_1(made: stage.SynthResult) -> None:
    truth, own = _take(made, "tryon_truth", "held_out"), _take(made, "subject_2", "held_out")
    assert np.array_equal(truth.poses.rotations, own.poses.rotations)
    assert np.array_equal(truth.poses.betas, own.poses.betas)
    motion = load_poses(made.motion, embedded_body())
    assert np.array_equal(motion.rotations, own.poses.rotations)
    with (
        np.load(made.captures["tryon_truth"] / "takes" / "held_out" / "gt" / "meshes.npz") as worn,
        np.load(made.captures["subject_1"] / "takes" / "held_out" / "gt" / "meshes.npz") as first,
    ):
        assert np.array_equal(worn["lower_f"], first["lower_f"])
        assert np.array_equal(worn["lower_uv"], first["lower_uv"])
        assert np.ptp(worn["lower_rest"][:, 0]) > np.ptp(first["lower_rest"][:, 0])  # graded to a larger body


def test_the_inner_truth_is_subject_2_without_the_vest(made: stage.SynthResult) -> None:
    inner, worn = _take(made, "inner_truth", "inner"), _take(made, "subject_2", "train")
    assert inner.split == "test" and set(inner.frames) <= set(worn.frames)
    frame = inner.frames[-1]
    revealed = 0
    for camera in inner.cameras:
        before, after = worn.labels(camera, frame), inner.labels(camera, frame)
        assert before is not None and after is not None
        same = after[before != 5] == before[before != 5]
        assert same.mean() > 0.999, "only a pixel that the vest shares with something else may change"
        revealed += int((after[before == 5] == 3).sum())
    assert revealed > 50, "the shirt shows where the vest was"


def test_the_same_seed_gives_the_same_files_for_any_number_of_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = []
    for name, seed, threads in (("one", 7, 2), ("two", 7, 1), ("three", 8, 2)):
        monkeypatch.setattr(stage, "WORKERS", threads)
        stage.run(tmp_path / name, SynthConfig(**{**MICRO.__dict__, "seed": seed}))
        total = hashlib.sha256()
        for path in sorted((tmp_path / name).rglob("*")):
            if path.is_file():
                total.update(str(path.relative_to(tmp_path / name)).encode() + path.read_bytes())
        digests.append(total.hexdigest())
    assert digests[0] == digests[1]
    assert digests[0] != digests[2]


def test_dry_run_writes_nothing(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app, ["synth", str(tmp_path / "out"), "--preset", "tiny", "--dry-run", "--json"]
    )
    assert result.exit_code == 0
    assert "cloth_spacing" in result.stdout
    assert not (tmp_path / "out").exists()


def test_an_unknown_preset_is_a_usage_error(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["synth", str(tmp_path / "out"), "--preset", "huge"])
    assert result.exit_code == 2
    assert not (tmp_path / "out").exists()
