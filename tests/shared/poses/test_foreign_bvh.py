"""BVH as other programs write it: text forms, names, roots, rest poses, frame counts."""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.shared.body import JOINT_INDEX
from stages.shared.errors import BadData, UsageProblem
from stages.shared.poses import load_poses
from stages.shared.poses.bvh_file import read_bvh_file
from stages.shared.poses.pose_arrays import PoseUnits
from tests.shared.poses import test_bvh as made
from tests.shared.poses.listening import Listening

Change = Callable[[str], str]
Z_UP = Rotation.from_euler("x", 90, degrees=True).as_matrix()


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    return made.write(tmp_path / "plain.bvh", *made.motion())


def same_motion(path: Path, plain: Path) -> None:
    np.testing.assert_allclose(made.joints_of(load_poses(path)), made.joints_of(load_poses(plain)), atol=1e-4)


_ENCODED: dict[str, Callable[[str], bytes]] = {
    "utf-8 mark": lambda text: codecs.BOM_UTF8 + text.encode(),
    "utf-16 little": lambda text: codecs.BOM_UTF16_LE + text.encode("utf-16-le"),
    "utf-16 big": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "latin name": lambda text: text.replace("Spine1", "Wirbelsäule").encode("latin-1"),
    "CRLF": lambda text: text.replace("\n", "\r\n").encode(),
    "old Mac": lambda text: text.replace("\n", "\r").encode(),
    "decimal comma": lambda text: re.sub(r"(\d)\.(\d)", r"\1,\2", text).encode(),
    "glued braces": lambda text: re.sub(r"\s*\{", "{", text).encode(),
    "one line a brace": lambda text: text.replace("}", "} ").encode(),
    "small keywords": lambda text: text.replace("MOTION", "motion").replace("Frames", "FRAMES").encode(),
    "small channels": lambda text: text.replace("Zrotation", "ZROTATION").encode(),
    "spaced colon": lambda text: text.replace("Frames:", "Frames :").encode(),
    "bone of the section's name": lambda text: text.replace("Spine1", "LOCOMOTION").encode(),
    "bone that ends like it": lambda text: text.replace("Spine1", "E MOTION").encode(),
    "blank lines": lambda text: text.replace("\n", "\n\n").encode(),
}


@pytest.mark.parametrize("name", _ENCODED)
def test_forms_of_the_text_change_nothing(name: str, plain: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.bvh"
    path.write_bytes(_ENCODED[name](plain.read_text()))
    same_motion(path, plain)


def rename(text: str, change: Change) -> str:
    return re.sub(r"(ROOT|JOINT) (\w+)", lambda match: f"{match[1]} {change(match[2])}", text)


def biped(name: str) -> str:
    """LeftUpLeg as Biped of 3ds Max says it: Bip01 L Thigh."""
    words = {"UpLeg": "Thigh", "Leg": "Calf", "ToeBase": "Toe0", "Shoulder": "Clavicle", "Arm": "UpperArm"}
    side = re.match(r"(Left|Right)(\w+)", name)
    if name == "Hips":
        return "Bip01"
    return f"Bip01 {side[1][0]} {words.get(side[2], side[2])}" if side else f"Bip01 {name}"


def smpl(name: str) -> str:
    """LeftUpLeg as SMPL exporters say it: L_Hip; the hand is the wrist, the toe the foot."""
    words = {
        "UpLeg": "Hip", "Leg": "Knee", "Foot": "Ankle", "ToeBase": "Foot", "Shoulder": "Collar",
        "Arm": "Shoulder", "ForeArm": "Elbow", "Hand": "Wrist",
    }  # fmt: skip
    side = re.match(r"(Left|Right)(\w+)", name)
    return f"{side[1][0]}_{words[side[2]]}" if side else {"Hips": "Pelvis"}.get(name, name)


def vroid(name: str) -> str:
    """LeftUpLeg as VRM files have it: J_Bip_L_UpLeg; the middle is C."""
    side = re.match(r"(Left|Right)(\w+)", name)
    return f"J_Bip_{side[1][0]}_{side[2]}" if side else f"J_Bip_C_{name}"


_NAMES: dict[str, Change] = {
    "mixamorig_": lambda name: "mixamorig_" + name,
    "mixamorig7:": lambda name: "mixamorig7:" + name,
    "two namespaces": lambda name: "scene:Actor01:" + name,
    "unknown prefix": lambda name: "Zed_" + name,
    "prefix of two words": lambda name: "Old-Rig_" + name,
    "path": lambda name: "Armature|" + name,
    "VRM": vroid,
    "suffix": lambda name: re.sub(r"^(Left|Right)(\w+)", lambda m: f"{m[2]}.{m[1][0]}", name),
    "lower case": lambda name: re.sub(r"^(Left|Right)(\w+)", lambda m: f"{m[2]}_{m[1][0]}", name).lower(),
    "upper case": lambda name: re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).upper(),
    "joint marks": lambda name: name + "_jnt",
    "Biped": biped,
    "SMPL": smpl,
    "knees": lambda name: name.replace("UpLeg", "Up").replace("Leg", "Knee").replace("Up", "Leg"),
}  # fmt: skip


@pytest.mark.parametrize("name", _NAMES)
def test_forms_of_the_names_change_nothing(name: str, plain: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.bvh"
    path.write_text(rename(plain.read_text(), _NAMES[name]))
    assert path.read_text() != plain.read_text()
    same_motion(path, plain)


def with_roots(text: str, channels: tuple[str, ...]) -> str:
    """The file with joints above the hips; each has channels that stay zero."""
    head, tail = text.split("MOTION")
    opening = ""
    for number, names in enumerate(channels):
        kind = "JOINT" if number else "ROOT"
        count = len(names.split())
        opening += f"{kind} Above{number}\n{{\nOFFSET 0 0 0\nCHANNELS {count} {names}\n"
    rows = tail.split("\n")
    zeros = "0 " * sum(len(names.split()) for names in channels)
    rows = [zeros + row if number > 2 and row else row for number, row in enumerate(rows)]
    head = head.replace("HIERARCHY\nROOT Hips", f"HIERARCHY\n{opening}JOINT Hips")
    return head + "}\n" * len(channels) + "MOTION" + "\n".join(rows)


@pytest.mark.parametrize(
    "channels",
    [
        ("Zrotation Xrotation Yrotation",),
        ("Xposition Yposition Zposition Zrotation Xrotation Yrotation",),
        ("", "Zrotation"),
        ("Yposition", "Xrotation Yrotation", ""),
    ],
)
def test_joints_above_the_hips_change_nothing(channels: tuple[str, ...], plain: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.bvh"
    path.write_text(with_roots(plain.read_text(), channels))
    same_motion(path, plain)


def test_position_channels_of_every_joint_are_used(tmp_path: Path) -> None:
    text = """HIERARCHY
ROOT A
{ OFFSET 0 0 0 CHANNELS 3 Xposition Yposition Zposition
JOINT B { OFFSET 9 9 9 CHANNELS 4 Zposition Xposition Zrotation Yposition
JOINT C { OFFSET 0 2 0 CHANNELS 0 } } }
MOTION
Frames: 2
Frame Time: 0.1
0 0 0 3 1 90 2
1 0 0 3 1 0 2
"""
    path = tmp_path / "a.bvh"
    path.write_text(text)
    motion = read_bvh_file(path)
    np.testing.assert_allclose(motion.world()[1][0], [[0, 0, 0], [1, 2, 3], [-1, 2, 3]], atol=1e-12)
    np.testing.assert_allclose(motion.world()[1][1], [[1, 0, 0], [2, 2, 3], [2, 4, 3]], atol=1e-12)
    np.testing.assert_allclose(motion.rest_positions()[1], [1, 2, 3])


@pytest.mark.parametrize("turn", [(90, 0, 0), (-90, 0, 0), (0, 0, 90), (180, 0, 0)])
def test_a_person_who_lies_in_the_whole_clip_keeps_lying(turn: tuple[float, ...], tmp_path: Path) -> None:
    angles, roots = made.motion()
    angles *= 0.3
    lying = Rotation.from_euler("xyz", turn, degrees=True)
    standing = Rotation.from_euler("ZXY", angles[:, 0], degrees=True)
    angles[:, 0] = (lying * standing).as_euler("ZXY", degrees=True)
    roots = lying.apply(roots)
    listening = Listening()
    poses = load_poses(made.write(tmp_path / "a.bvh", angles, roots), report=listening)
    joints, expected = made.joints_of(poses), made.chain(angles, roots)
    for start, end, bone, below in made.LIMBS:
        ours = made.unit(joints[:, JOINT_INDEX[end]] - joints[:, JOINT_INDEX[start]])
        np.testing.assert_allclose(ours, made.unit(expected[below] - expected[bone]), atol=1e-5)
    assert "torso is more than 60° from upright in 100 %" in listening.text and "--up" in listening.text


def test_up_can_be_said(tmp_path: Path) -> None:
    angles, roots = made.motion()
    plain = made.joints_of(load_poses(made.write(tmp_path / "a.bvh", angles, roots)))
    for axis, turn in (
        ("z", Z_UP),
        ("-z", Z_UP.T),
        ("x", Rotation.from_euler("z", -90, degrees=True).as_matrix()),
    ):
        angled = angles.copy()
        root = Rotation.from_matrix(turn) * Rotation.from_euler("ZXY", angles[:, 0], degrees=True)
        angled[:, 0] = root.as_euler("ZXY", degrees=True)
        path = made.write(tmp_path / "b.bvh", angled, roots @ turn.T)
        np.testing.assert_allclose(made.joints_of(load_poses(path, up=axis)), plain, atol=1e-4)
    with pytest.raises(UsageProblem, match="BVH"):
        load_poses(path, units=PoseUnits(degrees=True))


def with_arms(degrees: float) -> tuple:
    """The skeleton with arms that hang by an angle in the rest pose."""
    rows = []
    for name, parent, offset in made.SKELETON:
        if name.endswith(("ForeArm", "Hand")):
            angle = -degrees if name.startswith("Left") else degrees
            offset = tuple(Rotation.from_euler("z", angle, degrees=True).apply(offset))
        rows.append((name, parent, offset))
    return tuple(rows)


@pytest.mark.parametrize("degrees", [30, 45, 80])
def test_limbs_of_other_rest_poses_point_where_the_file_says(
    degrees: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(made, "SKELETON", with_arms(degrees))
    angles, roots = made.motion()
    joints = made.joints_of(load_poses(made.write(tmp_path / "a.bvh", angles, roots)))
    expected = made.chain(angles, roots)
    for start, end, bone, below in made.LIMBS:
        ours = made.unit(joints[:, JOINT_INDEX[end]] - joints[:, JOINT_INDEX[start]])
        np.testing.assert_allclose(ours, made.unit(expected[below] - expected[bone]), atol=1e-5)


def test_a_rest_pose_that_faces_another_way_changes_nothing(tmp_path: Path) -> None:
    angles, roots = made.motion()
    plain = made.joints_of(load_poses(made.write(tmp_path / "a.bvh", angles, roots)))
    for degrees in (33.0, 90.0, 135.0):
        turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        turned = made.joints_of(load_poses(made.write(tmp_path / "b.bvh", angles, roots, turn=turn)))
        relative = (turned - turned[:, :1]) @ turn
        np.testing.assert_allclose(relative, plain - plain[:, :1], atol=2e-3)


def replaced(**offsets: tuple[float, float, float]) -> tuple:
    return tuple((name, parent, offsets.get(name, offset)) for name, parent, offset in made.SKELETON)


def along(axis: int) -> tuple:
    """All bones along one axis of the file, as in LAFAN1."""
    return tuple(
        (
            name,
            parent,
            tuple(np.linalg.norm(offset) * np.eye(3)[axis]) if parent and len(name) > 6 else offset,
        )
        for name, parent, offset in made.SKELETON
    )


@pytest.mark.parametrize(
    ("skeleton", "reason"),
    [
        (along(0), "not a standing person"),
        (along(2), "not a standing person"),
        (replaced(LeftLeg=(3, 0, 42), RightLeg=(-3, 0, 42)), "leg does not point down|thigh does not"),
        (replaced(LeftToeBase=(0, -6, -14), RightToeBase=(0, -6, -14)), "foot does not point to the front"),
        (replaced(LeftToeBase=(14, -2, 0)), "left foot does not point to the front"),
        (replaced(RightForeArm=(28, 0, 0)), "right arm does not point to its own side"),
    ],
)  # fmt: skip
def test_rest_poses_without_a_known_twist_are_refused(
    skeleton: tuple, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(made, "SKELETON", skeleton)
    path = made.write(tmp_path / "a.bvh", *made.motion())
    with pytest.raises(BadData, match=reason) as refusal:
        load_poses(path)
    assert "T-pose" in refusal.value.fix


@pytest.mark.parametrize("claimed", [0, 3, 5, 99_999_999_999])
def test_whole_rows_are_read_whatever_the_count_says(claimed: int, plain: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.bvh"
    path.write_text(plain.read_text().replace("Frames: 4", f"Frames: {claimed}"))
    listening = Listening()
    assert len(load_poses(path, report=listening)) == 4
    assert f"states {claimed} frames and holds 4 rows" in listening.text
    same_motion(path, plain)


def test_frames_that_run_over_several_lines_are_read(plain: Path, tmp_path: Path) -> None:
    head, rows = re.split(r"(?<=Frame Time: 0.025\n)", plain.read_text())
    path = tmp_path / "other.bvh"
    path.write_text(head + rows.replace(" ", "\n", 200))
    same_motion(path, plain)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row.rsplit(" ", 1)[0], "line 132 has 65 numbers, 66 are expected"),
        (lambda row: row + " 1.0", "line 132 has 67 numbers"),
        (lambda row: row.replace(" ", "", 1), "line 132 has 65 numbers, 66 are expected, near '"),
        (lambda row: re.sub(r"^\S+", "-1.#IND", row), "line 132 holds '-1.#IND'"),
        (lambda row: re.sub(r"\S+$", "inf", row), "line 132 holds NaN or infinity: 'inf'"),
        (lambda row: re.sub(r"\S+$", "1_0", row).replace("1_0", "0x1p3"), "line 132 holds '0x1p3'"),
    ],
)
def test_a_bad_row_is_named_by_line_and_text(
    change: Change, message: str, plain: Path, tmp_path: Path
) -> None:
    lines = plain.read_text().split("\n")
    lines[131] = change(lines[131])
    path = tmp_path / "other.bvh"
    path.write_text("\n".join(lines))
    with pytest.raises(BadData) as refusal:
        load_poses(path)
    assert message in refusal.value.what


def test_a_frame_rate_can_be_said(plain: Path) -> None:
    assert load_poses(plain, units=PoseUnits(fps=120.0)).fps == 120.0
