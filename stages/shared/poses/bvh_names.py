"""Which bone of somebody else's skeleton is which of our joints, by the conventions for their names."""

from __future__ import annotations

import re

from stages.shared.body.skeleton import JOINT_INDEX

_SIDE_ROLES: dict[str, tuple[str, ...]] = {
    "hip": ("upleg", "hip", "thigh", "upperleg", "upleg1", "femur"),
    "knee": ("leg", "knee", "shin", "calf", "lowerleg", "lowleg", "tibia"),
    "ankle": ("foot", "ankle"),
    "foot": ("toebase", "toe", "toes", "toe0", "forefoot", "ball", "football"),
    "collar": ("collar", "clavicle", "collarbone"),
    "shoulder": ("arm", "uparm", "upperarm", "humerus"),
    "elbow": ("forearm", "elbow", "lowerarm", "lowarm", "radius"),
    "wrist": ("hand", "wrist"),
}
_FINGER = re.compile(r"(?:hand|finger)?(thumb|index|middle|mid|ring|pinky|little)(?:finger)?0?([123])$")
_FINGER_NAMES = {"mid": "middle", "little": "pinky"}
_SPINE_WORDS = ("spine", "chest", "back", "torso", "abdomen", "thorax", "waist")


def joint_of_bone(names: tuple[str, ...], parents: tuple[int, ...]) -> dict[int, int]:
    """Our joint index -> bone index, for every joint that the skeleton has.

    Knows the names in use by CMU and HumanIK ("LeftUpLeg", "LeftForeArm"), by Poser and Biovision ("LeftHip",
    "LeftElbow"), by game engines ("thigh_l", "upperarm_r") and by Mixamo (a prefix and a colon).

    Arguments:
        names, parents: the skeleton; the root is first.
    """
    split = [_side_and_name(name) for name in names]
    found: dict[int, int] = {JOINT_INDEX["pelvis"]: 0}
    for side in ("left", "right"):
        own = {name: bone for bone, (bone_side, name) in enumerate(split) if bone_side == side}
        for role, words in _SIDE_ROLES.items():
            bone = next((own[word] for word in words if word in own), None)
            if bone is not None:
                found[JOINT_INDEX[f"{side}_{role}"]] = bone
        _place_shoulder(found, own, side)
        found.update(_fingers(own, side))
    found.update(_middle(split, parents))
    return found


def _side_and_name(name: str) -> tuple[str, str]:
    """("left" | "right" | "", the rest), lower case and without prefixes and signs."""
    bare = re.sub(r"[^a-z0-9:]", "", re.sub(r"[\s_.\-]+", "_", name).lower().replace("_", ""))
    bare = bare.rsplit(":", 1)[-1]
    marked = re.sub(r"[\s.\-]+", "_", name.rsplit(":", 1)[-1])
    for side in ("left", "right"):
        letter = side[0]
        if bare.startswith(side):
            return side, bare.removeprefix(side)
        if bare.endswith(side):
            return side, bare.removesuffix(side)
        if re.search(rf"_{letter}$", marked, re.IGNORECASE):
            return side, bare[:-1]
        if re.match(rf"{letter}_", marked, re.IGNORECASE) or re.match(rf"(?i:{letter})[A-Z]", marked):
            return side, bare[1:]
    return "", bare


def _place_shoulder(found: dict[int, int], own: dict[str, int], side: str) -> None:
    """A bone called "shoulder" is the collar bone where there is an upper arm too, else the upper arm."""
    if "shoulder" not in own:
        return
    shoulder, collar = JOINT_INDEX[f"{side}_shoulder"], JOINT_INDEX[f"{side}_collar"]
    if shoulder in found:
        found.setdefault(collar, own["shoulder"])
    else:
        found[shoulder] = own["shoulder"]


def _fingers(own: dict[str, int], side: str) -> dict[int, int]:
    """Fingers of which all three joints are there; stumps of one joint are markers, not fingers."""
    joints: dict[str, dict[int, int]] = {}
    for name, bone in own.items():
        match = _FINGER.match(name)
        if match:
            finger = _FINGER_NAMES.get(match[1], match[1])
            joints.setdefault(finger, {})[int(match[2])] = bone
    return {
        JOINT_INDEX[f"{side}_{finger}{knuckle}"]: bone
        for finger, bones in joints.items()
        if len(bones) == 3
        for knuckle, bone in bones.items()
    }


def _middle(split: list[tuple[str, str]], parents: tuple[int, ...]) -> dict[int, int]:
    """Spine, neck and head: the chain from the root up to the head."""
    middle = {bone: name for bone, (side, name) in enumerate(split) if not side and bone}
    heads = [bone for bone, name in middle.items() if name == "head"]
    necks = [bone for bone, name in middle.items() if name.startswith("neck")]
    spine = sorted(
        (bone for bone, name in middle.items() if name.startswith(_SPINE_WORDS) or name == "lowerback"),
        key=lambda bone: _depth(bone, parents),
    )
    found: dict[int, int] = {}
    if heads:
        found[JOINT_INDEX["head"]] = heads[0]
    if necks:
        found[JOINT_INDEX["neck"]] = max(necks, key=lambda bone: _depth(bone, parents))
    if spine:
        # Rotations are carried over in the world, so leaving out bones in between loses nothing.
        found[JOINT_INDEX["spine3"]] = spine[-1]
        if len(spine) > 1:
            found[JOINT_INDEX["spine1"]] = spine[0]
        if len(spine) > 2:
            found[JOINT_INDEX["spine2"]] = spine[len(spine) // 2]
    return found


def _depth(bone: int, parents: tuple[int, ...]) -> int:
    depth = 0
    while parents[bone] >= 0:
        bone, depth = parents[bone], depth + 1
    return depth
