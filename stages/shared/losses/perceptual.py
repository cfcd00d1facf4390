"""LPIPS v0.1 on VGG-16 features (Zhang et al. 2018), from a weight file that the user gives.

Pictures become features after relu1_2, 2_2, 3_3, 4_3 and 5_3; channels are scaled to unit length at every
pixel, differences squared, weighted per channel by a linear head, averaged over pixels, summed over layers.

The picture terms compare square crops: around the subject's mask and around the face.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional

from stages.shared.body import BodyModel, Poses, bone_transforms, shaped_joints
from stages.shared.body.skeleton import PARENTS
from stages.shared.capture.camera import Box, Camera
from stages.shared.errors import BadData, MissingInput
from stages.shared.finite import finite

# Convolutions of VGG-16 (index in the stack of torchvision, channels in, channels out), block by block; every
# one is followed by a ReLU, and a block but the first begins by halving the picture.
BLOCKS = (
    ((0, 3, 64), (2, 64, 64)),
    ((5, 64, 128), (7, 128, 128)),
    ((10, 128, 256), (12, 256, 256), (14, 256, 256)),
    ((17, 256, 512), (19, 512, 512), (21, 512, 512)),
    ((24, 512, 512), (26, 512, 512), (28, 512, 512)),
)
SMALLEST_SIDE = 16  # px; below, the last block has no pixel left
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10
_HEAD = 15
_FACE_ABOVE_JOINT = 0.06  # m, along the head's own up
_FACE_RADIUS = 0.15  # m
_SMALLEST_FACE = 16  # px


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor that a weight file must hold; others in it are not read."""
    shapes: dict[str, tuple[int, ...]] = {}
    for layer, block in enumerate(BLOCKS):
        for index, inputs, outputs in block:
            shapes[f"features.{index}.weight"] = (outputs, inputs, 3, 3)
            shapes[f"features.{index}.bias"] = (outputs,)
        shapes[f"lin{layer}.model.1.weight"] = (1, block[-1][2], 1, 1)
    return shapes


@dataclass(frozen=True, eq=False)
class Perceptual:
    """The metric; `tensors` are those of `tensor_shapes`, f32, on one device and held fixed."""

    tensors: dict[str, Tensor]

    @classmethod
    def load(cls, path: Path) -> Perceptual:
        """From a safetensors file (docs/formats.md).

        Raises:
            MissingInput: no such file. BadData: not safetensors, or a tensor is absent, of another shape, or
            not finite.
        """
        if not path.is_file():
            raise MissingInput("There is no file with perceptual weights.", str(path), "Check the path.")
        try:
            with safe_open(path, framework="pt") as file:
                there = set(file.keys())
                return cls({n: _checked(file, there, n, s, path) for n, s in tensor_shapes().items()})
        except (SafetensorError, OSError) as error:
            raise BadData(
                f"This file cannot be read as perceptual weights: {error}.",
                str(path),
                "Give a safetensors file with the tensors listed in docs/formats.md.",
            ) from error

    def to(self, device: torch.device) -> Perceptual:
        """The same on `device`."""
        return Perceptual({name: tensor.to(device) for name, tensor in self.tensors.items()})

    def distance(self, image: Tensor, truth: Tensor) -> Tensor:
        """LPIPS of two pictures (H, W, 3) sRGB 0..1, sides at least 16; the truth gets no gradient."""
        with torch.no_grad():
            expected = self._features(truth)
        total = torch.zeros((), dtype=image.dtype, device=image.device)
        for layer, (actual, target) in enumerate(zip(self._features(image), expected, strict=True)):
            head = self.tensors[f"lin{layer}.model.1.weight"].to(image.dtype)
            total = total + functional.conv2d((actual - target).square(), head).mean()
        return finite(total, "lpips", image=image, truth=truth)

    def _features(self, image: Tensor) -> list[Tensor]:
        """Five maps (1, C, h, w) of unit-length features."""
        shift, scale = image.new_tensor(_SHIFT), image.new_tensor(_SCALE)
        values = ((2.0 * image - 1.0 - shift) / scale).permute(2, 0, 1)[None]
        features: list[Tensor] = []
        for block in BLOCKS:
            if features:
                values = functional.max_pool2d(values, 2)
            for index, _, _ in block:
                weight, bias = (self.tensors[f"features.{index}.{kind}"] for kind in ("weight", "bias"))
                values = functional.conv2d(values, weight.to(image.dtype), bias.to(image.dtype), padding=1)
                values = values.relu()
            # vector_norm, not the root of a sum: its gradient is 0 where all channels are
            length = finite(torch.linalg.vector_norm(values, dim=1, keepdim=True), "lpips", image=image)
            features.append(values / (length + _EPSILON))
        return features


def _checked(file: safe_open, there: set[str], name: str, shape: tuple[int, ...], path: Path) -> Tensor:
    """One tensor of the file, as f32."""
    fix = "Give a file with VGG-16 and LPIPS v0.1 weights as listed in docs/formats.md."
    if name not in there:
        raise BadData(f"The perceptual weights lack the tensor {name}.", str(path), fix)
    tensor = file.get_tensor(name)
    if tuple(tensor.shape) != shape or not tensor.is_floating_point():
        problem = f"The tensor {name} is {tensor.dtype} {tuple(tensor.shape)}, not floating point {shape}."
        raise BadData(problem, str(path), fix)
    tensor = tensor.float()
    if not bool(tensor.isfinite().all()):
        raise BadData(f"The tensor {name} has values that are not finite.", str(path), fix)
    return tensor


def mask_box(mask: Tensor, margin: int = 0) -> Box | None:
    """Tight box of the pixels of a mask (H, W) > 0.5, `margin` px wider and clipped; None where none is."""
    rows, columns = (torch.nonzero((mask > 0.5).any(dim=axis))[:, 0] for axis in (1, 0))
    if not len(rows):
        return None
    height, width = mask.shape
    left, top = max(0, int(columns[0]) - margin), max(0, int(rows[0]) - margin)
    return left, top, min(width, int(columns[-1]) + 1 + margin), min(height, int(rows[-1]) + 1 + margin)


def square_crop(image: Tensor, box: Box, side: int, background: Tensor) -> Tensor:
    """(side, side, 3): the box of an image (H, W, 3), centred in a square of `background` (3,), bilinear."""
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    longest = max(width, height)
    x, y = (longest - width) // 2, (longest - height) // 2
    # over the background, so that zeros of the padding stand for it
    part = (image[top:bottom, left:right] - background).permute(2, 0, 1)[None]
    square = functional.pad(part, (x, longest - width - x, y, longest - height - y))
    return functional.interpolate(square, (side, side), mode="bilinear")[0].permute(1, 2, 0) + background


def face_centre(body: BodyModel, poses: Poses, frame: int) -> NDArray[np.float64]:
    """(3,) m, world: 0.06 m above the head joint of a row of `poses`, along the head's own up."""
    rotations, translation = (torch.from_numpy(a[frame]) for a in (poses.rotations, poses.translation))
    joints = shaped_joints(body, torch.from_numpy(poses.betas))
    posed_from_rest = bone_transforms(rotations, joints, PARENTS, translation)[_HEAD].double().numpy()
    centre = joints[_HEAD].double().numpy() + (0.0, _FACE_ABOVE_JOINT, 0.0)
    return np.asarray(posed_from_rest[:3, :3] @ centre + posed_from_rest[:3, 3])


def face_box(camera: Camera, centre: NDArray[np.float64]) -> Box | None:
    """Box of a sphere 0.30 m wide at `centre` (3,) world, clipped; None below 16 px, or behind the camera."""
    pixel, depth = camera.project(centre)
    if depth <= _FACE_RADIUS:
        return None
    reach = _FACE_RADIUS / float(depth) * camera.intrinsics.diagonal()[:2]
    low, high = pixel - reach, pixel + reach
    left, top = max(0, math.floor(low[0])), max(0, math.floor(low[1]))
    right, bottom = min(camera.width, math.ceil(high[0])), min(camera.height, math.ceil(high[1]))
    return (left, top, right, bottom) if min(right - left, bottom - top) >= _SMALLEST_FACE else None
