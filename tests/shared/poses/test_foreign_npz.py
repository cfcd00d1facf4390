"""Pose arrays as other programs store them: layouts, types, sizes, units, axes, frame rates."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.shared.body import Poses, embedded_body
from stages.shared.errors import BadData, UsageProblem
from stages.shared.poses import load_poses
from stages.shared.poses.pose_arrays import PoseUnits
from tests.shared.poses.listening import Listening

T = 5
RANDOM = np.random.default_rng(3)
ROOT, BODY = RANDOM.normal(0, 0.2, (T, 3)), RANDOM.normal(0, 0.3, (T, 63))
HANDS, FACE = RANDOM.normal(0, 0.3, (T, 90)), RANDOM.normal(0, 0.1, (T, 9))
MOVE = RANDOM.normal(0, 0.02, (T, 3))
NONE, TWO = np.zeros((T, 3)), np.full((T, 6), 0.4)


def matrices(vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(T, -1, 3, 3)


def join(*parts: np.ndarray) -> np.ndarray:
    return np.concatenate(parts, axis=1)


def read(tmp_path: Path, arrays: dict[str, Any], **options: Any) -> Poses:
    np.savez(tmp_path / "a.npz", **arrays)
    return load_poses(tmp_path / "a.npz", embedded_body(), **options)


_BODIES: dict[str, dict[str, np.ndarray]] = {
    "AMASS 66": {"poses": join(ROOT, BODY), "trans": MOVE},
    "AMASS 72": {"poses": join(ROOT, BODY, TWO), "trans": MOVE},
    "AMASS 156": {"poses": join(ROOT, BODY, HANDS), "trans": MOVE},
    "AMASS 165": {"poses": join(ROOT, BODY, FACE, HANDS), "trans": MOVE},
    "AMASS joints": {"poses": join(ROOT, BODY, TWO).reshape(T, 24, 3), "trans": MOVE},
    "AMASS matrices": {"poses": matrices(join(ROOT, BODY, TWO)), "trans": MOVE},
    "AMASS split": {"root_orient": ROOT, "pose_body": BODY, "pose_hand": HANDS, "trans": MOVE},
    "AMASS split, body alone": {"root_orient": ROOT, "pose_body": BODY, "trans": MOVE},
    "SMPL-X": {"global_orient": ROOT, "body_pose": BODY, "transl": MOVE},
    "SMPL 69": {"global_orient": ROOT, "body_pose": join(BODY, TWO), "transl": MOVE},
    "SMPL 72 with the root": {"body_pose": join(ROOT, BODY, TWO), "transl": MOVE},
    "SMPL-X 66 with the root": {"body_pose": join(ROOT, BODY), "transl": MOVE},
    "joints": {"global_orient": ROOT[:, None], "body_pose": BODY.reshape(T, 21, 3), "transl": MOVE},
    "matrices": {"global_orient": matrices(ROOT), "body_pose": matrices(BODY), "transl": MOVE},
    "flat matrices": {
        "global_orient": matrices(ROOT).reshape(T, 9),
        "body_pose": matrices(join(BODY, TWO)).reshape(T, -1),
        "transl": MOVE,
    },
    "one matrix a frame": {"global_orient": matrices(ROOT)[:, 0], "body_pose": BODY, "trans": MOVE},
    "EasyMocap 63": {"poses": BODY, "Rh": ROOT, "Th": MOVE},
    "EasyMocap 66": {"poses": join(NONE, BODY), "Rh": ROOT, "Th": MOVE},
    "EasyMocap 69": {"poses": join(BODY, TWO), "Rh": ROOT, "Th": MOVE},
    "EasyMocap 72": {"poses": join(NONE, BODY, TWO), "Rh": ROOT, "Th": MOVE},
    "EasyMocap 78": {"poses": join(NONE, BODY, np.zeros((T, 12))), "Rh": ROOT, "Th": MOVE},
    "EasyMocap 156": {"poses": join(NONE, BODY, HANDS), "Rh": ROOT, "Th": MOVE},
    "EasyMocap 165": {"poses": join(NONE, BODY, FACE, HANDS), "Rh": ROOT, "Th": MOVE},
}  # fmt: skip


@pytest.mark.parametrize("name", _BODIES)
def test_every_layout_has_the_same_body(name: str, tmp_path: Path) -> None:
    poses = read(tmp_path, _BODIES[name], up="y")
    np.testing.assert_allclose(poses.rotations[:, 0], ROOT, atol=1e-6)
    np.testing.assert_allclose(poses.rotations[:, 1:22].reshape(T, 63), BODY, atol=1e-6)
    if "156" in name or "165" in name or ("split" in name and "alone" not in name):
        np.testing.assert_allclose(poses.rotations[:, 25:].reshape(T, 90), HANDS, atol=1e-6)
    else:
        assert not poses.rotations[:, 25:].any()
    if "165" in name:
        np.testing.assert_allclose(poses.rotations[:, 22:25].reshape(T, 9), FACE, atol=1e-6)
    if not name.startswith("EasyMocap"):
        np.testing.assert_allclose(poses.translation, MOVE, atol=1e-6)


PARAMS = {"global_orient": ROOT, "body_pose": BODY, "transl": MOVE, "betas": np.zeros((1, 10)), "fps": 30.0}
_RECORD = np.zeros((T, 3), dtype=[("x", "f4")])


@pytest.mark.parametrize("values", [
    MOVE.astype(complex), _RECORD, MOVE.astype("S"), MOVE.astype("U"), MOVE > 0, np.zeros((T, 3), "M8[s]"),
])  # fmt: skip
@pytest.mark.parametrize("name", ["transl", "betas", "global_orient"])
def test_arrays_of_another_type_are_refused(name: str, values: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(BadData, match=f"{name} is not numeric"):
        read(tmp_path, {**PARAMS, name: values})


@pytest.mark.parametrize("size", [1e39, -1e300, np.longdouble("1e400")])
@pytest.mark.parametrize(("name", "layout"), [
    ("transl", PARAMS), ("body_pose", PARAMS), ("betas", PARAMS), ("trans", _BODIES["AMASS 156"]),
    ("poses", _BODIES["AMASS 156"]), ("Th", _BODIES["EasyMocap 72"]),
])  # fmt: skip
def test_numbers_beyond_32_bits_are_refused(
    name: str, layout: dict[str, Any], size: float, tmp_path: Path
) -> None:
    values = np.asarray(layout[name]).astype(np.longdouble)
    values[-1, -1] = size
    with pytest.raises(BadData, match=r"32 bits|NaN or infinity") as refusal:
        read(tmp_path, {**layout, name: values})
    assert "[" in refusal.value.where


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"betas": np.zeros((0, 10))}, r"betas has shape \(0, 10\)"),
        ({"flat_hand_mean": np.zeros(0), "left_hand_pose": np.zeros((T, 45))}, "flat_hand_mean has shape"),
        ({"flat_hand_mean": np.array(["yes"]), "left_hand_pose": np.zeros((T, 45))}, "flat_hand_mean"),
        ({"global_orient": ROOT[:3]}, "global_orient has 3 rows"),
        ({"global_orient": np.zeros((T, 4))}, r"global_orient has shape \(5, 4\)"),
        ({"body_pose": np.zeros((T, 21, 4))}, r"body_pose has shape \(5, 21, 4\)"),
        ({"body_pose": np.ones((T, 21, 3, 3))}, "frame 0, joint 0"),
        ({"body_pose": -matrices(BODY)}, "not a rotation"),
        ({"fps": np.array([30.0, 60.0])}, "frame rate"),
        ({"fps": np.array("30")}, "frame rate"),
    ],
)  # fmt: skip
def test_other_shapes_are_refused_as_stored(arrays: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(BadData, match=message):
        read(tmp_path, {**PARAMS, **arrays})


def claim(path: Path, shape: str, packed: int = 0) -> None:
    """An `.npz` whose body_pose claims a shape and holds `packed` MiB of zeros."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        with archive.open("body_pose.npy", "w") as stream:
            stream.write(member)
            for _ in range(packed):
                stream.write(bytes(1 << 20))
        for name in ("global_orient", "transl"):
            buffer = io.BytesIO()
            np.save(buffer, np.zeros((1, 3), np.float32))
            archive.writestr(name + ".npy", buffer.getvalue())


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("(4200000, 63)", "4200000 frames"),
        ("(900000, 63)", "would grow from"),
        ("(True, 63)", "not a shape"),
        ("(-1, 63)", r"not a shape|cannot be read"),
        ("(10**30, 63)", "cannot be read"),
        ("(1" + "0" * 30 + ", 63)", "frames"),
    ],
)
def test_the_header_is_believed_only_within_bounds(
    shape: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reading(*arguments: object, **options: object) -> None:
        raise AssertionError("an array was read")

    claim(tmp_path / "a.npz", shape)
    monkeypatch.setattr(np.lib.format, "read_array", reading)
    with pytest.raises(BadData, match=message):
        load_poses(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["fps", "mocap_framerate", "mocap_frame_rate", "framerate"])
@pytest.mark.parametrize("layout", ["AMASS 156", "SMPL-X", "EasyMocap 72"])
def test_a_frame_rate_is_found_under_every_name(layout: str, name: str, tmp_path: Path) -> None:
    listening = Listening()
    assert read(tmp_path, {**_BODIES[layout], name: np.array(120.0)}, report=listening).fps == 120.0
    assert "frame rate" not in listening.text


@pytest.mark.parametrize("layout", ["AMASS 156", "SMPL-X", "EasyMocap 72", "AMASS split"])
def test_a_missing_frame_rate_is_said(layout: str, tmp_path: Path) -> None:
    listening = Listening()
    assert read(tmp_path, _BODIES[layout], report=listening).fps == 30.0
    assert "30 frames per second are assumed" in listening.text and "--file-fps" in listening.text
    assert read(tmp_path, _BODIES[layout], units=PoseUnits(fps=50)).fps == 50


def test_resampling_is_bounded(tmp_path: Path) -> None:
    for slow in (1e-5, 1e-4, 5e-4):
        with pytest.raises(UsageProblem, match="the limit is 200000"):
            read(tmp_path, {**PARAMS, "fps": slow}, fps=30)


def test_a_motion_needs_neither_shape_nor_translation(tmp_path: Path) -> None:
    changing = np.tile(np.linspace(0, 1, T)[:, None], (1, 10))
    for arrays, said in (
        ({**PARAMS, "betas": changing}, "mean is kept"),
        ({name: values for name, values in PARAMS.items() if name != "transl"}, "no translation"),
        ({name: values for name, values in PARAMS.items() if name != "betas"}, ""),
    ):
        listening = Listening()
        poses = read(tmp_path, arrays, report=listening)
        assert len(poses) == T and said in listening.text
    with pytest.raises(BadData, match="shape changes"):
        read(tmp_path, {**PARAMS, "betas": changing}, one_person=True)


STILL = {name: values * 0 if name != "fps" else values for name, values in PARAMS.items()}
WALK = np.stack([np.zeros(T), np.full(T, 0.9), np.linspace(0, 0.16, T)], axis=1)
QUARTER = np.tile([np.pi / 2, 0, 0], (T, 1))


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"body_pose": np.degrees(BODY)}, ("full turn", "--degrees")),
        ({"global_orient": np.degrees(0 * ROOT + [0, 3.0, 0]), "body_pose": np.degrees(BODY)}, ("degrees",)),
        ({"transl": 1000 * WALK}, ("faster than 15 m/s", "--length-unit mm")),
        ({"transl": 100 * WALK}, ("faster than 15 m/s", "--length-unit mm or cm")),
        ({"transl": 1000 * WALK[:1].repeat(T, 0)}, ("900 m from the origin", "--length-unit")),
        ({"transl": np.vstack([WALK[:4], WALK[4:] + 9])},
         ("in 1 steps", "--file-fps")),
        ({"global_orient": QUARTER}, ("upright in 100 %", "--up z")),
        ({"global_orient": -QUARTER}, ("upright in 100 %", "--up -z")),
        ({"global_orient": 2 * QUARTER}, ("upright in 100 %", "--up -y")),
    ],
)  # fmt: skip
def test_what_no_person_does_is_warned_of_with_its_cure(
    arrays: dict[str, np.ndarray], words: tuple[str, ...], tmp_path: Path
) -> None:
    listening = Listening()
    silent = read(tmp_path, {**STILL, **arrays})
    poses = read(tmp_path, {**STILL, **arrays}, report=listening)
    assert len(listening.warnings) == 1 and all(word in listening.text for word in words)
    assert poses.to_npz_bytes() == silent.to_npz_bytes()


def test_a_plausible_motion_is_not_warned_of(tmp_path: Path) -> None:
    for arrays in ({"transl": WALK}, {"body_pose": BODY}, {"global_orient": 0.6 * QUARTER, "transl": WALK}):
        listening = Listening()
        read(tmp_path, {**STILL, **arrays}, report=listening)
        assert listening.warnings == []


def test_units_and_axes_can_be_said(tmp_path: Path) -> None:
    plain = read(tmp_path, {**PARAMS, "transl": WALK})
    degrees = {"global_orient": np.degrees(ROOT), "body_pose": np.degrees(BODY), "transl": WALK * 1000}
    other = read(tmp_path, {**PARAMS, **degrees}, units=PoseUnits(degrees=True, metres=0.001))
    np.testing.assert_allclose(other.rotations, plain.rotations, atol=1e-6)
    np.testing.assert_allclose(other.translation, plain.translation, atol=1e-6)
