"""Drivers move the texels of garments, the same in the plain and the cached way of posing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import pytest
import torch
from torch import Tensor

from stages.shared.avatar.decoders.registry import new_decoder
from stages.shared.avatar.deform import blended
from stages.shared.avatar.pose import FramePose, frame_pose
from stages.shared.body import Poses
from stages.shared.errors import UsageProblem
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit
from tests.shared.avatar.test_blendshapes import CONFIG as BLENDSHAPES
from tests.shared.outfit.wardrobe import motion, outfit

POSES = motion(5)


@dataclass
class Lifted:
    """The bones' own matrices, as a driver with a matrix per texel would hand them out, and 0.1 m higher."""

    outfit: Outfit
    kind: str = "simulated"
    residual: Tensor | None = None
    prepared: list[int] = field(default_factory=list)

    def prepare(self, poses: Poses, rows: Sequence[int]) -> None:
        self.prepared += rows

    def matrices(self, poses: Poses, row: int) -> Tensor:
        pose = _pose(self.outfit, poses, row)
        matrices = blended(self.outfit.layers[1].maps.skin_weights, pose.transforms).clone()
        matrices[:, 1, 3] += 0.1
        return matrices


def _pose(dressed: Outfit, poses: Poses, row: int) -> FramePose:
    arrays = (poses.rotations[row], poses.translation[row], dressed.betas)
    return frame_pose(dressed.body_model, *(torch.from_numpy(array) for array in arrays))


def _same(one: Outfit, row: int) -> None:
    cached, plain = CachedPoser(one).composite(POSES, row), one.composite(POSES, row)
    for name, tolerance in (("means", 5e-6), ("covariances", 1e-7), ("opacities", 1e-6), ("features", 1e-6)):
        assert torch.allclose(getattr(cached, name), getattr(plain, name), atol=tolerance), name


def test_a_matrix_per_texel_takes_the_place_of_the_bones() -> None:
    dressed = outfit("body", "lower", "upper")
    driver = Lifted(dressed)
    lifted = replace(dressed, drivers={"lower": driver})
    lifted.prepare(POSES, [1, 3])
    assert driver.prepared == [1, 3]
    for row in (1, 3):
        _same(lifted, row)
        before, after = dressed.posed(POSES, row), lifted.posed(POSES, row)
        high = torch.tensor([0.0, 0.1, 0.0])
        assert torch.allclose(after["lower"].means, before["lower"].means + high, atol=1e-6)
        assert torch.allclose(after["lower"].covariances, before["lower"].covariances)
        assert torch.equal(after["upper"].means, before["upper"].means)


def test_bones_keep_the_attributes_in_all_poses() -> None:
    dressed = outfit("body", "lower")
    model = new_decoder(dressed.layers[1].maps, BLENDSHAPES, 3)
    model.fit_input([_pose(dressed, POSES, row).local_transforms for row in (0, 2, 4)])
    with torch.no_grad():
        for parameter in (*model.parameters(), model.state_dict()["mean_residual"]):
            parameter.add_(torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)) * 0.1)
    garment = replace(dressed.layers[1], model=model.requires_grad_(False))
    learned = replace(dressed, layers=(dressed.layers[0], garment))
    bones = learned.driven("lower=bones")
    mean = model.attributes(model.mean_residual_of_training())
    for row in (0, 4):
        _same(bones, row)
        assert torch.allclose(bones.posed(POSES, row)["lower"].offsets, mean.offsets)
    assert not torch.allclose(learned.posed(POSES, 4)["lower"].offsets, mean.offsets)
    assert learned.driven("auto").drivers["lower"].kind == "learned"


@pytest.mark.parametrize(
    ("drive", "message"),
    [
        ("magic", "no drive 'magic'"),
        ("lower=magic", "no drive 'magic'"),
        ("outer=bones", "no garment 'outer'"),
        ("simulated", "no simulation mesh"),
    ],
)
def test_what_cannot_be_driven_is_refused(drive: str, message: str) -> None:
    with pytest.raises(UsageProblem, match=message):
        outfit("body", "lower").driven(drive)
