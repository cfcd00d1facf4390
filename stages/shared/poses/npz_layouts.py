"""Pose arrays in the `.npz` layouts of SMPL, SMPL-H and SMPL-X programs, read into `Poses`.

Known by their arrays:

- `smpl_params.npz` (Animatable Gaussians, ActorsHQ, THuman4, this project): `body_pose`, `global_orient`,
`transl`. - AMASS: `poses` and `trans`, or the same split into `root_orient`, `pose_body`, `pose_hand`,
`pose_jaw`, `pose_eye`. - EasyMocap and ZJU-MoCap: `poses`, `Rh`, `Th`, which turn and move the body about
the world's origin.

Joints may be axis-angle vectors or rotation matrices. Of SMPL's 23 body joints the last two, which stand
for the hands, have no counterpart and are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.model import BodyModel
from stages.shared.body.npz import NumericNpz
from stages.shared.body.poses import DEFAULT_FPS, Poses
from stages.shared.body.skeleton import (
    BODY,
    EXPRESSION_COUNT,
    JAW,
    JOINT_COUNT,
    LEFT_EYE,
    LEFT_HAND,
    RIGHT_EYE,
    RIGHT_HAND,
    SHAPE_COUNT,
)
from stages.shared.errors import BadData
from stages.shared.poses.pose_arrays import KNOWN_LAYOUTS, PoseArrays, PoseUnits

Doubles = NDArray[np.float64]
Note = Callable[[str], None]

_FPS_NAMES = ("fps", "mocap_framerate", "mocap_frame_rate", "framerate", "frame_rate")
_HAND_VALUES = 45
_BODY_JOINTS, _SMPL_BODY_JOINTS = 21, 23


def read_pose_arrays(
    file: NumericNpz,
    body: BodyModel | None,
    note: Note,
    one_person: bool = False,
    units: PoseUnits = PoseUnits(),
) -> tuple[Poses, str]:
    """Poses of an open `.npz`, and the axis of its world that its layout says points up ("y" or "z").

    Arguments:
        body: model of the poses. Needed for hands as coefficients and for EasyMocap's translation.
        note: is called with sentences about what was assumed or left out.
        one_person: the file is a fit of one person: translation and one shape for all frames are required.
            For a motion that another body follows neither is.

    Raises:
        BadData: unknown layout, missing arrays, other shapes, values that are not finite real numbers in 32
            bits.
    """
    if not file.names & {"poses", "body_pose", "pose_body"}:
        have = ", ".join(sorted(file.names)[:20]) or "nothing"
        raise BadData("The file has no body poses.", f"{file.path} (it has: {have})", KNOWN_LAYOUTS)
    layouts = _Layouts(file, PoseArrays(file, units), body, note, one_person, units)
    if {"poses", "Rh", "Th"} <= file.names:
        return layouts.easymocap(), "y"
    if "body_pose" in file:
        return layouts.smpl_params(), "y"
    return layouts.amass(), "z"


def stated_fps(file: NumericNpz) -> float | None:
    """Frames per second that the file states; None when it states none. Raises BadData for another value."""
    name = next((name for name in _FPS_NAMES if name in file), None)
    if name is None:
        return None
    values = file.array(name, finite=False)
    if values.size != 1 or values.dtype.kind not in "iuf" or not 0 < float(values.reshape(())) < 1e5:
        raise BadData(
            "The frame rate is not one positive number.", f"{file.path}: {name}", "Store fps as a number."
        )
    return float(values.reshape(()))


@dataclass(frozen=True)
class _Layouts:
    file: NumericNpz
    arrays: PoseArrays
    body: BodyModel | None
    note: Note
    one_person: bool
    units: PoseUnits

    def smpl_params(self) -> Poses:
        """`body_pose` of 21 or 23 joints with `global_orient`, or of 22 or 24 joints that begin with the
        root.
        """
        if "global_orient" in self.file:
            joints = self.arrays.joints("body_pose", (_BODY_JOINTS, _SMPL_BODY_JOINTS))
            root = self.arrays.joints("global_orient", (1,), len(joints))
        else:
            joints = self.arrays.joints("body_pose", (1 + _BODY_JOINTS, 1 + _SMPL_BODY_JOINTS))
            root, joints = joints[:, :1], joints[:, 1:]
        frames = len(joints)
        rotations = np.zeros((frames, JOINT_COUNT, 3))
        rotations[:, :1], rotations[:, BODY] = root, joints[:, :_BODY_JOINTS]
        for name, joint in (("jaw_pose", JAW), ("leye_pose", LEFT_EYE), ("reye_pose", RIGHT_EYE)):
            if name in self.file:
                rotations[:, joint] = self.arrays.joints(name, (1,), frames)[:, 0]
        for side, hand in (("left", LEFT_HAND), ("right", RIGHT_HAND)):
            if f"{side}_hand_pose" in self.file:
                rotations[:, hand] = self._hand_parameters(side, frames)
        return self._poses(rotations, self._translation(("transl", "trans"), frames), self._betas("betas"))

    def amass(self) -> Poses:
        """`poses` of 22, 24, 52 or 55 joints that begin with the root, or the split arrays."""
        rotations: Doubles
        if "poses" in self.file:
            joints = self.arrays.joints("poses", (22, 24, 52, JOINT_COUNT))
            rotations = np.zeros((len(joints), JOINT_COUNT, 3))
            rotations[:, : 1 + _BODY_JOINTS] = joints[:, : 1 + _BODY_JOINTS]
            if joints.shape[1] == JOINT_COUNT:
                rotations[:, 22:] = joints[:, 22:]
            elif joints.shape[1] == 52:
                rotations[:, LEFT_HAND], rotations[:, RIGHT_HAND] = joints[:, 22:37], joints[:, 37:]
        else:
            joints = self.arrays.joints("pose_body", (_BODY_JOINTS, _SMPL_BODY_JOINTS))
            frames = len(joints)
            rotations = np.zeros((frames, JOINT_COUNT, 3))
            rotations[:, BODY] = joints[:, :_BODY_JOINTS]
            root = "root_orient" if "root_orient" in self.file else "global_orient"
            rotations[:, :1] = self.arrays.joints(root, (1,), frames)
            parts = {"pose_jaw": slice(22, 23), "pose_eye": slice(23, 25), "pose_hand": slice(25, 55)}
            for name, place in parts.items():
                if name in self.file:
                    rotations[:, place] = self.arrays.joints(name, (place.stop - place.start,), frames)
        # The betas of AMASS belong to another, gendered shape space.
        return self._poses(
            rotations, self._translation(("trans", "transl"), len(rotations)), np.zeros(SHAPE_COUNT)
        )

    def easymocap(self) -> Poses:
        """`poses` with `Rh` and `Th`: x_world = Rh x + Th, so the translation depends on the pelvis."""
        if self.body is None:
            raise BadData(
                "EasyMocap's translation needs the body model that was fitted.",
                str(self.file.path),
                "Give it with --body-model.",
            )
        values = self.arrays.matrix("poses")
        columns = values.shape[1]
        rooted = columns in (66, 72, 78, 156, 165) or (columns == 87 and not values[:, :3].any())
        if columns not in (63, 66, 69, 72, 78, 87, 156, 165):
            raise self.arrays.wrong("poses", "63, 66, 69, 72, 78, 87, 156 or 165 values per frame")
        if rooted and values[:, :3].any():
            raise BadData(
                "The first joint of poses turns the root, and so does Rh.",
                f"{self.file.path}: poses, Rh",
                "Store zeros in the first three values of poses, or leave Rh and Th out.",
            )
        frames = len(values)
        root = self.arrays.joints("Rh", (1,), frames)[:, 0]
        first = 3 if rooted else 0
        rotations = np.zeros((frames, JOINT_COUNT, 3))
        rotations[:, 0] = root
        rotations[:, BODY] = self.arrays.angles(values[:, first : first + 63]).reshape(
            frames, _BODY_JOINTS, 3
        )
        rest = values[:, first + 63 :]
        if columns in (78, 87):
            count = 6 if rooted else 12
            rotations[:, LEFT_HAND] = self._hand("poses", "left", rest[:, :count], flat=rooted)
            rotations[:, RIGHT_HAND] = self._hand("poses", "right", rest[:, count : 2 * count], flat=rooted)
            if rooted and columns == 87:
                rotations[:, JAW : RIGHT_EYE + 1] = self.arrays.angles(rest[:, 12:]).reshape(frames, 3, 3)
        elif columns in (156, 165):
            place = slice(22 if columns == 165 else 25, JOINT_COUNT)
            rotations[:, place] = self.arrays.angles(rest).reshape(frames, -1, 3)
        betas = self._betas("shapes")
        pelvis = self.body.joint_template[0] + self.body.joint_directions[0] @ betas
        moves = self.arrays.rows("Th", 3, frames) * self.units.metres
        return self._poses(rotations, moves + Rotation.from_rotvec(root).apply(pelvis) - pelvis, betas)

    def _poses(self, rotations: Doubles, translation: Doubles, betas: Doubles) -> Poses:
        expression = np.zeros((len(rotations), EXPRESSION_COUNT))
        if "expression" in self.file:
            values = self.arrays.rows("expression", None, len(rotations))[:, :EXPRESSION_COUNT]
            expression[:, : values.shape[1]] = values
        fps = self.units.fps or stated_fps(self.file)
        if fps is None and not self.one_person:
            self.note(
                f"the file states no frame rate: {DEFAULT_FPS:g} frames per second are assumed; "
                "state another with gw poses --file-fps."
            )
        arrays = {"rotations": rotations, "translation": translation, "betas": betas}
        for name, values in arrays.items():
            with np.errstate(over="ignore"):
                narrow = values.astype(np.float32)
            if not np.isfinite(narrow).all():
                index = [int(i) for i in np.argwhere(~np.isfinite(narrow))[0]]
                raise BadData(
                    f"{name} is beyond what 32 bits can hold.",
                    f"{self.file.path}: {name}{index}",
                    KNOWN_LAYOUTS,
                )
        return Poses(
            rotations.astype(np.float32),
            translation.astype(np.float32),
            betas.astype(np.float32),
            expression.astype(np.float32),
            DEFAULT_FPS if fps is None else fps,
        )

    def _translation(self, names: tuple[str, ...], frames: int) -> Doubles:
        name = next((name for name in names if name in self.file), None)
        if name is None and self.one_person:
            self.file.array(names[0])  # raises: it names what the file has instead
        if name is None:
            self.note("the file has no translation: the root stays at its place.")
            return np.zeros((frames, 3))
        return self.arrays.rows(name, 3, frames) * self.units.metres

    def _betas(self, name: str) -> Doubles:
        """(10,); the mean where they change from frame to frame, which only a motion may."""
        if name not in self.file:
            if self.one_person and name == "betas":
                self.file.array(name)
            return np.zeros(SHAPE_COUNT)
        values = np.atleast_2d(self.arrays.numbers(name))
        if values.ndim != 2 or not values.size:
            raise self.arrays.wrong(name, "one row of shape coefficients")
        if np.abs(values - values[0]).max() > 1e-3:
            if self.one_person:
                raise BadData(
                    "The body shape changes from frame to frame; one person has one shape.",
                    f"{self.file.path}: {name} {values.shape}",
                    "Store one row of betas (fit the shape once for all frames).",
                )
            self.note(
                f"{name} change from frame to frame: their mean is kept; the wearer's own shape is used."
            )
        betas = np.zeros(SHAPE_COUNT)
        used = values.mean(axis=0)[:SHAPE_COUNT] if len(values) > 1 else values[0, :SHAPE_COUNT]
        betas[: len(used)] = used
        return betas

    def _hand_parameters(self, side: str, frames: int) -> Doubles:
        """(T, 15, 3) of `left_hand_pose` or `right_hand_pose`: 45 angles, matrices, or fewer coefficients.

        Without `flat_hand_mean` angles are around a flat hand and coefficients around the model's mean
        hand, as both are in use.
        """
        name = f"{side}_hand_pose"
        shape = self.arrays.shape(name, frames)
        columns = int(np.prod(shape[1:], dtype=object))
        flat = columns >= _HAND_VALUES
        if "flat_hand_mean" in self.file:
            values = self.file.array("flat_hand_mean")
            if values.size != 1 or values.dtype.kind not in "biuf":
                raise self.arrays.wrong("flat_hand_mean", "one truth value")
            flat = bool(values.reshape(())[()])
        if columns < _HAND_VALUES:
            return self._hand(name, side, self.arrays.rows(name, None, frames), flat)
        joints = self.arrays.joints(name, (15,), frames)
        return joints if flat else joints + self._mean_hand(name, side).reshape(15, 3)

    def _hand(self, name: str, side: str, coefficients: Doubles, flat: bool) -> Doubles:
        """(T, 15, 3) axis-angle out of coefficients (T, K) of the body model's hand space."""
        components = getattr(self.body, f"hand_components_{side}", None)
        count = coefficients.shape[1]
        if flat and not coefficients.any():
            return np.zeros((len(coefficients), 15, 3))
        if not count or components is None or len(components) < count:
            raise BadData(
                f"The {side} hand is {count} coefficients, and the body model has no hand space for them.",
                f"{self.file.path}: {name}",
                "Give the body model of the fit (--body-model), or store 45 axis-angle values per hand.",
            )
        values = coefficients @ components[:count].astype(np.float64)
        return (values if flat else values + self._mean_hand(name, side)).reshape(-1, 15, 3)

    def _mean_hand(self, name: str, side: str) -> Doubles:
        mean = getattr(self.body, f"hand_mean_{side}", None)
        if mean is None:
            raise BadData(
                "The hands are relative to a mean hand (flat_hand_mean), which the body model lacks.",
                f"{self.file.path}: {name}",
                "Give the body model of the fit (--body-model), or add the mean hand to the poses.",
            )
        return np.asarray(mean, np.float64).reshape(-1)
