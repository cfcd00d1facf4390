"""Which bone of another program's skeleton is which joint of the body: by names, and by how bones hang
together.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise, product

from stages.shared.body.skeleton import JOINT_INDEX

# For every joint of a side the usual names of its bone, the most certain first.
_ROLES: dict[str, tuple[str, ...]] = {
    "hip": ("upleg", "thigh", "upperleg", "upleg1", "femur", "hip", "buttock", "leg"),
    "knee": ("lowerleg", "lowleg", "calf", "shin", "tibia", "knee", "leg"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toes", "toe0", "forefoot", "ball", "football", "foot"),
    "collar": ("collar", "clavicle", "collarbone", "shoulder"),
    "shoulder": ("upperarm", "uparm", "humerus", "shldr", "arm", "shoulder"),
    "elbow": ("forearm", "lowerarm", "lowarm", "elbow", "radius"),
    "wrist": ("wrist", "hand"),
}
_VOCABULARY = {word for words in _ROLES.values() for word in words}
_FINGER = re.compile(r"(?:hand|finger)?(thumb|index|middle|mid|ring|pinky|little)(?:finger)?0?([123])$")
_FINGER_NAMES = {"mid": "middle", "little": "pinky"}
# Words in front of names that say which program or part of a rig a bone belongs to.
_PREFIX_WORDS = {
    "mixamorig", "bip", "biped", "character", "robot", "armature", "valvebiped", "cc", "base", "j", "def",
    "rig", "skeleton", "genesis", "actor", "bn", "b", "c", "jnt", "bone",
}  # fmt: skip
_SUFFIX_WORDS = {"jnt", "bone", "bind", "skin"}
_PREFIX_SHARE = 0.6  # of all names that begin with a word, for it to be a prefix
# Runs of capitals, capitalised words, digits: "LUpLeg" is L, Up, Leg.
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


def joint_of_bone(names: tuple[str, ...], parents: tuple[int, ...]) -> dict[int, int]:
    """Joint index to bone index, for every joint of the body that the skeleton has.

    Knows the names in use by CMU and HumanIK ("LeftUpLeg"), Poser and Biovision ("LeftHip"), game engines
    ("thigh_l"), Biped ("Bip01 L Thigh"), VRM ("J_Bip_L_UpperLeg") and SMPL ("L_Hip"), with any prefix that
    the bones share. Where several bones could be a joint, those are taken that hang together as a limb. The
    pelvis is the joint from which both legs start, and the spine is the way from there to where both arms
    start.

    Arguments:
        names, parents: the skeleton; the root is first.
    """
    tree = _Tree(parents)
    split = _sides_and_names(names)
    joints: dict[int, int] = {}
    for side in ("left", "right"):
        bones: dict[str, int] = {}
        for bone, (bone_side, name) in enumerate(split):
            if bone_side == side:
                bones.setdefault(name, bone)
        limb = {
            **tree.limb(bones, ("hip", "knee", "ankle")),
            **tree.limb(bones, ("shoulder", "elbow", "wrist")),
        }
        limb |= _end_of_limb(tree, bones, limb, "foot", below="ankle")
        limb |= _end_of_limb(tree, bones, limb, "collar", above="shoulder")
        joints |= {JOINT_INDEX[f"{side}_{role}"]: bone for role, bone in limb.items()}
        joints.update(_fingers(bones, side))
    legs, arms = (
        [
            joints[JOINT_INDEX[f"{side}_{name}"]]
            for side in ("left", "right")
            if JOINT_INDEX[f"{side}_{name}"] in joints
        ]
        for name in ("hip", "shoulder")
    )
    pelvis = tree.common(legs) if len(legs) == 2 else 0
    joints[JOINT_INDEX["pelvis"]] = pelvis
    chest = tree.common(arms) if len(arms) == 2 else None
    joints.update(_middle(tree, split, pelvis, chest))
    return joints


class _Tree:
    """Parents of bones, and what follows from them."""

    def __init__(self, parents: tuple[int, ...]) -> None:
        self.parents = parents

    def line(self, bone: int) -> list[int]:
        """The bone and all above it, up to the root."""
        bones = [bone]
        while self.parents[bones[-1]] >= 0:
            bones.append(self.parents[bones[-1]])
        return bones

    def below(self, bone: int, above: int) -> bool:
        """Whether `bone` hangs somewhere below `above`."""
        return bone != above and above in self.line(bone)

    def common(self, bones: list[int]) -> int:
        """The lowest bone above all of `bones`."""
        lines = [self.line(bone)[1:] or [bone] for bone in bones]
        return next((bone for bone in lines[0] if all(bone in line for line in lines[1:])), 0)

    def limb(self, bones: dict[str, int], roles: tuple[str, str, str]) -> dict[str, int]:
        """As many bones of a limb as hang below each other, from the body outwards, with the surest names."""
        choices: list[list[tuple[int, int | None]]] = [
            [(rank, bones[word]) for rank, word in enumerate(_ROLES[role]) if word in bones] + [(0, None)]
            for role in roles
        ]
        best: dict[str, int] = {}
        least = (0, 0)
        for chosen in product(*choices):
            here = {role: bone for role, (_, bone) in zip(roles, chosen, strict=True) if bone is not None}
            order = list(here.values())
            cost = -len(order), sum(rank for rank, _ in chosen)
            if cost < least and all(self.below(b, a) for a, b in pairwise(order)):
                best, least = here, cost
        return best


def _end_of_limb(
    tree: _Tree, bones: dict[str, int], limb: dict[str, int], role: str, above: str = "", below: str = ""
) -> dict[str, int]:
    """The toe below the ankle, or the collar bone above the shoulder."""
    for word in _ROLES[role]:
        bone = bones.get(word)
        if bone is None or bone in limb.values():
            continue
        if below and below in limb and not tree.below(bone, limb[below]):
            continue
        if above and above in limb and not tree.below(limb[above], bone):
            continue
        return {role: bone}
    return {}


def _sides_and_names(names: tuple[str, ...]) -> list[tuple[str, str]]:
    """For every bone "left", "right" or "", and the rest of its name in lower case without prefixes."""
    words = [_WORD.findall(re.split(r"[:|/]", name)[-1]) for name in names]
    words = [[word.lower() for word in parts] for parts in words]
    for _ in range(4):
        first = Counter(parts[0] for parts in words if len(parts) > 1)
        if not first:
            break
        prefix, count = first.most_common(1)[0]
        shared = count >= _PREFIX_SHARE * sum(first.values()) or prefix in _PREFIX_WORDS
        if not shared or prefix in ("left", "right", "l", "r"):
            break
        words = [parts[1:] if parts[:1] == [prefix] else parts for parts in words]
    return [_side_and_name(parts) for parts in words]


def _side_and_name(words: list[str]) -> tuple[str, str]:
    while len(words) > 1 and (words[0] in _PREFIX_WORDS or words[0].isdigit()):
        words = words[1:]
    while len(words) > 1 and words[-1] in _SUFFIX_WORDS:
        words = words[:-1]
    for word, side in (("left", "left"), ("right", "right"), ("l", "left"), ("r", "right")):
        if word in words and len(words) > 1:
            place = words.index(word)
            return side, _known("".join(words[:place] + words[place + 1 :]))
    name = "".join(words)
    for side in ("left", "right"):
        if name.startswith(side):
            return side, name.removeprefix(side)
        if name.endswith(side):
            return side, name.removesuffix(side)
        if name[:1] == side[0] and name[1:] in _VOCABULARY:
            return side, name[1:]
    return "", name


def _known(name: str) -> str:
    """The name without digits at its end, where only that is the name of a joint: "thigh001" is a thigh."""
    bare = name.rstrip("0123456789")
    return bare if name not in _VOCABULARY and bare in _VOCABULARY else name


def _fingers(bones: dict[str, int], side: str) -> dict[int, int]:
    """Fingers of which all three joints are there; stumps of one joint are markers, not fingers."""
    joints: dict[str, dict[int, int]] = {}
    for name, bone in bones.items():
        match = _FINGER.match(name)
        if match:
            finger = _FINGER_NAMES.get(match[1], match[1])
            joints.setdefault(finger, {})[int(match[2])] = bone
    return {
        JOINT_INDEX[f"{side}_{finger}{knuckle}"]: bone
        for finger, knuckles in joints.items()
        if len(knuckles) == 3
        for knuckle, bone in knuckles.items()
    }


def _middle(tree: _Tree, split: list[tuple[str, str]], pelvis: int, chest: int | None) -> dict[int, int]:
    """Spine, neck and head: the bones from the pelvis to the chest, and those called neck and head above."""
    joints: dict[int, int] = {}
    if chest is not None and tree.below(chest, pelvis):
        line = tree.line(chest)
        spine = [
            bone
            for bone in line[: line.index(pelvis)][::-1]
            if not split[bone][1].startswith(("neck", "head"))
        ]
        # Rotations are taken over in the world, so that bones in between may be left out.
        if spine:
            joints[JOINT_INDEX["spine3"]] = spine[-1]
        if len(spine) > 1:
            joints[JOINT_INDEX["spine1"]] = spine[0]
        if len(spine) > 2:
            joints[JOINT_INDEX["spine2"]] = spine[len(spine) // 2]
    heads = list(_called(split, "head"))
    necks = list(_called(split, "neck"))
    if heads:
        joints[JOINT_INDEX["head"]] = heads[0]
    if necks:
        joints[JOINT_INDEX["neck"]] = max(necks, key=lambda bone: len(tree.line(bone)))
    return joints


def _called(split: list[tuple[str, str]], word: str) -> Iterator[int]:
    for bone, (side, name) in enumerate(split):
        if not side and (name == word or (word == "neck" and name.startswith(word))):
            yield bone
