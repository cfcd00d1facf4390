"""BVH: reading against an independent chain, retargeting by what must not change, real and broken files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.shared.body import JOINT_INDEX, Poses, embedded_body, posed_joints, posed_vertices
from stages.shared.errors import BadData
from stages.shared.poses import load_poses
from stages.shared.poses.bvh_file import read_bvh_file
from stages.shared.poses.bvh_names import joint_of_bone

# name, parent, offset (y up, facing +z, T-pose with legs somewhat apart)
SKELETON = (
    ("Hips", None, (0.0, 0.0, 0.0)),
    ("Spine", "Hips", (0.0, 10.0, 0.0)),
    ("Spine1", "Spine", (0.0, 15.0, 0.0)),
    ("Neck", "Spine1", (0.0, 25.0, 0.0)),
    ("Head", "Neck", (0.0, 10.0, 2.0)),
    ("LeftShoulder", "Spine1", (4.0, 20.0, 0.0)),
    ("LeftArm", "LeftShoulder", (14.0, 0.0, 0.0)),
    ("LeftForeArm", "LeftArm", (28.0, 0.0, 0.0)),
    ("LeftHand", "LeftForeArm", (26.0, 0.0, 0.0)),
    ("RightShoulder", "Spine1", (-4.0, 20.0, 0.0)),
    ("RightArm", "RightShoulder", (-14.0, 0.0, 0.0)),
    ("RightForeArm", "RightArm", (-28.0, 0.0, 0.0)),
    ("RightHand", "RightForeArm", (-26.0, 0.0, 0.0)),
    ("LeftUpLeg", "Hips", (9.0, -5.0, 0.0)),
    ("LeftLeg", "LeftUpLeg", (3.0, -42.0, 1.0)),
    ("LeftFoot", "LeftLeg", (0.0, -40.0, -2.0)),
    ("LeftToeBase", "LeftFoot", (0.0, -6.0, 14.0)),
    ("RightUpLeg", "Hips", (-9.0, -5.0, 0.0)),
    ("RightLeg", "RightUpLeg", (-3.0, -42.0, 1.0)),
    ("RightFoot", "RightLeg", (0.0, -40.0, -2.0)),
    ("RightToeBase", "RightFoot", (0.0, -6.0, 14.0)),
)
NAMES = [name for name, _, _ in SKELETON]
LIMBS = [
    (f"{side}_{a}", f"{side}_{b}", f"{side.title()}{c}", f"{side.title()}{d}")
    for side in ("left", "right")
    for a, b, c, d in (
        ("hip", "knee", "UpLeg", "Leg"),
        ("knee", "ankle", "Leg", "Foot"),
        ("shoulder", "elbow", "Arm", "ForeArm"),
        ("elbow", "wrist", "ForeArm", "Hand"),
    )
]


def motion(frames: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Euler angles (T, B, 3) in degrees in the order Z X Y, and root positions (T, 3)."""
    random = np.random.default_rng(8)
    angles = random.normal(0, 25, (frames, len(SKELETON), 3))
    angles[:, 0] *= 0.3  # stay upright
    return angles, random.normal(0, 10, (frames, 3)) + [0, 95, 0]


def write(
    path: Path, angles: np.ndarray, roots: np.ndarray, scale: float = 1.0, turn: np.ndarray | None = None
) -> Path:
    """A BVH file; `turn` (3, 3) writes the same motion in turned axes."""
    turn = np.eye(3) if turn is None else turn
    lines = ["HIERARCHY"]

    def joint(name: str, depth: int) -> None:
        pad = "\t" * depth
        offset = turn @ np.array(next(o for n, _, o in SKELETON if n == name)) * scale
        lines.append(f"{pad}{'JOINT' if depth else 'ROOT'} {name}")
        lines.append(pad + "{")
        lines.append(f"{pad}\tOFFSET {offset[0]:.9f} {offset[1]:.9f} {offset[2]:.9f}")
        places = "" if depth else "Xposition Yposition Zposition "
        lines.append(f"{pad}\tCHANNELS {3 if depth else 6} {places}Zrotation Xrotation Yrotation")
        children = [n for n, parent, _ in SKELETON if parent == name]
        for child in children:
            joint(child, depth + 1)
        if not children:
            lines.extend([pad + "\tEnd Site", pad + "\t{", pad + "\t\tOFFSET 0 1 0", pad + "\t}"])
        lines.append(pad + "}")

    joint("Hips", 0)
    lines += ["MOTION", f"Frames: {len(angles)}", "Frame Time: 0.025"]
    order = re.findall(r"(?:ROOT|JOINT) (\w+)", "\n".join(lines))
    for frame in range(len(angles)):
        numbers = list(turn @ roots[frame] * scale)
        for name in order:
            rotation = Rotation.from_euler("ZXY", angles[frame, NAMES.index(name)], degrees=True).as_matrix()
            numbers += list(Rotation.from_matrix(turn @ rotation @ turn.T).as_euler("ZXY", degrees=True))
        lines.append(" ".join(f"{number:.9f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


def chain(angles: np.ndarray, roots: np.ndarray) -> dict[str, np.ndarray]:
    """World positions (T, 3) by name, recursively, in the file's unit."""

    def world(name: str) -> tuple[np.ndarray, np.ndarray]:
        _, parent, offset = SKELETON[NAMES.index(name)]
        own = Rotation.from_euler("ZXY", angles[:, NAMES.index(name)], degrees=True).as_matrix()
        if parent is None:
            return own, roots
        rotation, position = world(parent)
        return rotation @ own, position + rotation @ np.array(offset)

    return {name: world(name)[1] for name in NAMES}


def joints_of(poses: Poses) -> np.ndarray:
    body = embedded_body()
    rotations, translation = (torch.from_numpy(v).double() for v in (poses.rotations, poses.translation))
    return posed_joints(body, rotations, translation, torch.zeros(10, dtype=torch.float64)).numpy()


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_file_positions_agree_with_an_independent_chain(tmp_path: Path) -> None:
    angles, roots = motion()
    read = read_bvh_file(write(tmp_path / "a.bvh", angles, roots))
    wanted = chain(angles, roots)
    positions = read.world()[1]
    for bone, name in enumerate(read.names):
        np.testing.assert_allclose(positions[:, bone], wanted[name], atol=1e-5)
    assert read.fps == pytest.approx(40.0)


def test_limbs_point_where_the_file_says(tmp_path: Path) -> None:
    angles, roots = motion()
    wanted = chain(angles, roots)
    joints = joints_of(load_poses(write(tmp_path / "a.bvh", angles, roots)))
    for start, end, bone, below in LIMBS:
        ours = unit(joints[:, JOINT_INDEX[end]] - joints[:, JOINT_INDEX[start]])
        np.testing.assert_allclose(ours, unit(wanted[below] - wanted[bone]), atol=1e-5)


def test_hips_go_the_same_way_in_metres_and_feet_stand_on_the_floor(tmp_path: Path) -> None:
    angles, roots = motion()
    wanted = chain(angles, roots)
    poses = load_poses(write(tmp_path / "a.bvh", angles, roots))
    joints = joints_of(poses)
    body = embedded_body().joint_template
    leg = np.linalg.norm(body[4] - body[1]) + np.linalg.norm(body[7] - body[4])
    theirs = np.linalg.norm(SKELETON[14][2]) + np.linalg.norm(SKELETON[15][2])
    hips = (wanted["LeftUpLeg"] + wanted["RightUpLeg"]) / 2 * leg / theirs
    np.testing.assert_allclose(
        np.diff((joints[:, 1] + joints[:, 2]) / 2, axis=0), np.diff(hips, axis=0), atol=1e-3
    )
    np.testing.assert_allclose(joints[0, 0, [0, 2]], 0, atol=1e-5)
    rotations, translation = (torch.from_numpy(v).double() for v in (poses.rotations, poses.translation))
    vertices = posed_vertices(embedded_body(), rotations, translation, torch.zeros(10, dtype=torch.float64))
    assert abs(float(vertices[..., 1].min())) < 0.05


def test_unit_and_up_axis_of_the_file_change_nothing(tmp_path: Path) -> None:
    angles, roots = motion()
    plain = load_poses(write(tmp_path / "a.bvh", angles, roots))
    inches = load_poses(write(tmp_path / "b.bvh", angles, roots, scale=1 / 2.54))
    z_up = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    upright = load_poses(write(tmp_path / "c.bvh", angles, roots, turn=z_up))
    for other in (inches, upright):
        np.testing.assert_allclose(joints_of(other), joints_of(plain), atol=1e-4)


def test_rest_pose_of_the_file_is_the_t_pose(tmp_path: Path) -> None:
    angles, roots = motion(1)
    poses = load_poses(write(tmp_path / "a.bvh", 0 * angles, roots))
    joints = joints_of(poses)[0]
    np.testing.assert_allclose(joints[20, 1], joints[16, 1], atol=1e-3)  # wrist as high as the shoulder
    assert np.abs(poses.rotations).max() < np.radians(15)  # legs straighten a little, nothing else moves


@pytest.mark.parametrize(
    ("names", "joint", "bone"),
    [
        (("mixamorig:Hips", "mixamorig:LeftUpLeg", "mixamorig:LeftLeg"), "left_knee", 2),
        (("pelvis", "thigh_l", "calf_l", "foot_l", "ball_l"), "left_foot", 4),
        (("Hips", "RightCollar", "RightShoulder", "RightElbow"), "right_collar", 1),
        (("Hips", "RightCollar", "RightShoulder", "RightElbow"), "right_shoulder", 2),
        (("Hips", "LeftShoulder", "LeftArm", "LeftForeArm"), "left_collar", 1),
        (("hip", "lThigh", "lShin", "lFoot"), "left_hip", 1),
        (("Hips", "L_UpperArm", "L_Forearm", "L_Hand", "L_Index1", "L_Index2", "L_Index3"), "left_index2", 5),
    ],
)
def test_names_by_convention(names: tuple[str, ...], joint: str, bone: int) -> None:
    assert joint_of_bone(names, tuple(range(-1, len(names) - 1)))[JOINT_INDEX[joint]] == bone


def test_a_single_finger_joint_is_no_finger() -> None:
    names = ("Hips", "LeftHand", "LeftHandIndex1", "LThumb")
    found = joint_of_bone(names, (-1, 0, 1, 1))
    assert JOINT_INDEX["left_index1"] not in found and JOINT_INDEX["left_thumb1"] not in found


@pytest.mark.parametrize(
    ("name", "up"),
    # The last clip moves in a world with z up over a rest pose with y up: only the user can tell.
    [("cmu_12_01_walk", None), ("bvh_test1", None), ("bvh_test2", None), ("bvh_test3", "z")],
)
def test_real_clips(shared_folder: Path, name: str, up: str | None) -> None:
    path = shared_folder / "poses" / f"{name}.bvh"
    if not path.is_file():
        pytest.skip("no clips beside the checkout (../shared/poses)")
    poses = load_poses(path, fps=30, up=up) if up else load_poses(path, fps=30)
    assert poses.fps == 30
    source = read_bvh_file(path)
    bone_of = joint_of_bone(source.names, source.parents)
    joints, positions = joints_of(poses), source.world()[1]
    upright = joints[:, 15, 1] - joints[:, [7, 8], 1].mean(1)
    assert upright.min() > 1.2  # head above the feet in all of them
    assert -0.02 < joints[:, [10, 11], 1].min() < 0.1  # a ball of the foot near the floor
    frames = np.round(np.arange(len(poses)) * source.fps / 30).astype(int)
    whole = np.abs(frames - np.arange(len(poses)) * source.fps / 30) < 1e-2
    for start, end, _, _ in LIMBS:
        a, b = JOINT_INDEX[start], JOINT_INDEX[end]
        theirs = unit(positions[frames, bone_of[b]] - positions[frames, bone_of[a]])[whole]
        ours = unit(joints[:, b] - joints[:, a])[whole]
        # Between pairs of bones angles are the same in every frame of reference.
        knee = unit(positions[frames, bone_of[JOINT_INDEX["left_knee"]]] - positions[frames, bone_of[1]])[
            whole
        ]
        ours_knee = unit(joints[:, 4] - joints[:, 1])[whole]
        np.testing.assert_allclose((ours * ours_knee).sum(-1), (theirs * knee).sum(-1), atol=2e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("MOTION", ""), "no MOTION"),
        (lambda text: text.replace("Frame Time: 0.025", "Frame Time: 0"), "claims"),
        (lambda text: text[: len(text) // 3], "no MOTION|incomplete"),
        (lambda text: re.sub(r"(Time: 0.025\n)\S+", r"\1nan", text), "line 130 holds NaN"),
        (lambda text: re.sub(r"(Time: 0.025\n)\S+", r"\1abc", text), "line 130 holds 'abc'"),
        (lambda text: text.replace("Zrotation", "Wrotation", 1), "channels"),
        (lambda text: text.replace("}", "", 1), "hierarchy"),
        (lambda text: text.replace("LeftLeg", "Bone7"), "not recognised by name"),
        (lambda text: text.replace("JOINT Spine\n", "ROOT Spine\n"), "more than one skeleton"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, change: object, message: str) -> None:
    path = write(tmp_path / "a.bvh", *motion())
    path.write_text(change(path.read_text()))  # type: ignore[operator]
    with pytest.raises(BadData, match=message):
        load_poses(path)
