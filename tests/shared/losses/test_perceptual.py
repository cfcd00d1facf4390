"""LPIPS against the same formula in plain numpy and scipy; its crops; its weight file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.signal import correlate2d

from stages.shared.body import Poses, embedded_body
from stages.shared.capture import Camera
from stages.shared.errors import BadData, MissingInput
from stages.shared.losses import perceptual as module
from stages.shared.losses.perceptual import Perceptual, face_box, face_centre, mask_box, square_crop
from stages.shared.metrics.scores import ViewPair, view_scores
from tests.shared.losses.perceptual_weights import random_weights

NARROW = (
    ((0, 3, 2), (2, 2, 3)),
    ((5, 3, 2), (7, 2, 4)),
    ((10, 4, 3), (12, 3, 2), (14, 2, 3)),
    ((17, 3, 2), (19, 2, 2), (21, 2, 3)),
    ((24, 3, 2), (26, 2, 3), (28, 3, 2)),
)


@pytest.fixture(scope="module")
def metric() -> Perceptual:
    return Perceptual(random_weights())


def _pictures(side: int = 32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    first, second = (torch.rand(side, side, 3, generator=generator) for _ in range(2))
    return first, second


def _camera(size: int = 100, depth: float = 2.0) -> Camera:
    matrix = np.eye(4)
    matrix[2, 3] = depth
    return Camera("c", size, size, np.array([[200.0, 0, size / 2], [0, 200, size / 2], [0, 0, 1]]), matrix)


def test_the_layout_is_that_of_the_public_files() -> None:
    shapes = module.tensor_shapes()
    assert len(shapes) == 31 and shapes["features.28.weight"] == (512, 512, 3, 3)
    assert sum(int(np.prod(s)) for name, s in shapes.items() if "features" in name) == 14_714_688
    assert [shapes[f"lin{i}.model.1.weight"][1] for i in range(5)] == [64, 128, 256, 512, 512]


def test_equal_pictures_have_distance_zero_and_others_a_gradient(metric: Perceptual) -> None:
    first, second = _pictures()
    assert metric.distance(first, first) == 0
    image = first.clone().requires_grad_()
    distance = metric.distance(image, second)
    distance.backward()
    assert distance > 0 and image.grad is not None
    assert torch.isfinite(image.grad).all() and image.grad.abs().max() > 0


def test_black_features_give_no_nan() -> None:
    dead = {name: -w.abs() if "bias" in name else w * 0 for name, w in random_weights(NARROW).items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BLOCKS", NARROW)
        image = _pictures()[0].requires_grad_()
        Perceptual(dead).distance(image, _pictures()[1]).backward()
    assert image.grad is not None and (image.grad == 0).all()


def test_numpy_finds_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BLOCKS", NARROW)
    weights = {name: tensor.double() for name, tensor in random_weights(NARROW).items()}
    first, second = (picture.double() for picture in _pictures(19))  # an odd side: pooling drops a row
    expected = _explicit(first.numpy(), second.numpy(), {k: v.numpy() for k, v in weights.items()})
    assert expected > 1e-4
    assert float(Perceptual(weights).distance(first, second)) == pytest.approx(expected, rel=1e-9)


def _explicit(first: np.ndarray, second: np.ndarray, weights: dict[str, np.ndarray]) -> float:
    total, maps = 0.0, [_shifted(first), _shifted(second)]
    for layer, block in enumerate(NARROW):
        maps = [_halved(values) for values in maps] if layer else maps
        for index, _, _ in block:
            kernel, bias = weights[f"features.{index}.weight"], weights[f"features.{index}.bias"]
            maps = [_convolved(values, kernel, bias) for values in maps]
        head = weights[f"lin{layer}.model.1.weight"].reshape(-1)
        height, width = maps[0].shape[1:]
        for row in range(height):
            for column in range(width):
                a, b = (m[:, row, column] / (np.sqrt((m[:, row, column] ** 2).sum()) + 1e-10) for m in maps)
                total += float(head @ (a - b) ** 2) / (height * width)
    return total


def _shifted(picture: np.ndarray) -> np.ndarray:
    values = (picture * 2 - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    return np.moveaxis(values, 2, 0)


def _halved(values: np.ndarray) -> np.ndarray:
    rows, columns = (size // 2 for size in values.shape[1:])
    return values[:, : 2 * rows, : 2 * columns].reshape(-1, rows, 2, columns, 2).max(axis=(2, 4))


def _convolved(values: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
    return np.stack(
        [
            np.maximum(sum(correlate2d(v, k, mode="same") for v, k in zip(values, one, strict=True)) + b, 0)
            for one, b in zip(kernel, bias, strict=True)
        ]
    )


def test_wrong_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BLOCKS", NARROW)
    good, path = random_weights(NARROW), tmp_path / "weights.safetensors"
    save_file(good | {"classifier.0.bias": torch.zeros(2)}, path)
    assert torch.equal(Perceptual.load(path).tensors["features.5.bias"], good["features.5.bias"])
    wrong = {
        "lin2.model.1.weight": torch.zeros(1, 7, 1, 1),
        "features.5.bias": torch.full((2,), float("nan")),
        "features.0.weight": None,
    }
    for name, tensor in wrong.items():
        bad = {key: value for key, value in good.items() if key != name}
        save_file(bad if tensor is None else bad | {name: tensor}, path)
        with pytest.raises(BadData) as refused:
            Perceptual.load(path)
        assert name in refused.value.what and refused.value.where == str(path) and refused.value.fix
    path.write_bytes(b"not a tensor in here")
    with pytest.raises(BadData, match="cannot be read"):
        Perceptual.load(path)
    with pytest.raises(MissingInput):
        Perceptual.load(tmp_path / "absent.safetensors")


def test_the_crop_of_a_mask_is_tight_square_and_centred() -> None:
    mask = torch.zeros(20, 30)
    mask[4:14, 8:12] = 1
    assert mask_box(mask) == (8, 4, 12, 14)
    assert mask_box(mask.bool(), margin=6) == (2, 0, 18, 20)
    assert mask_box(torch.zeros(5, 5)) is None
    image = torch.zeros(20, 30, 3)
    image[4:14, 8:12] = torch.rand(10, 4, 3)
    background = torch.tensor([0.2, 0.4, 0.6])
    crop = square_crop(image, (8, 4, 12, 14), 10, background)
    assert torch.allclose(crop[:, 3:7], image[4:14, 8:12], atol=1e-6)
    assert torch.allclose(crop[:, :3], background) and torch.allclose(crop[:, 7:], background)
    assert square_crop(image, (8, 4, 12, 14), 33, background).shape == (33, 33, 3)


def test_the_box_of_the_face_is_where_the_head_is() -> None:
    assert face_box(_camera(), np.zeros(3)) == (35, 35, 65, 65)  # 0.30 m at 2 m and 200 px
    assert face_box(_camera(), np.array([0.505, 0.0, 0.0])) is None  # 15 px of it are left
    assert face_box(_camera(), np.array([5.0, 0.0, 0.0])) is None
    assert face_box(_camera(), np.array([0.0, 0.0, -4.0])) is None
    assert face_box(_camera(depth=6.0), np.zeros(3)) is None  # 10 px
    body, turned = embedded_body(), np.zeros((2, 55, 3), np.float32)
    turned[1, 0, 2] = np.pi  # upside down about the pelvis
    poses = Poses(turned, np.zeros((2, 3)), np.zeros(10), np.zeros((2, 10)))  # type: ignore[arg-type]
    upright, upside_down = (face_centre(body, poses, frame) for frame in range(2))
    joints = body.joint_regressor @ body.template_vertices
    assert np.allclose(upright, joints[15] + [0, 0.06, 0], atol=1e-4)
    assert upside_down[1] == pytest.approx(2 * joints[0, 1] - upright[1], abs=1e-4)


def test_scores_have_lpips_only_with_the_metric(metric: Perceptual, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.shared.metrics.scores._LPIPS_SIDE", 32)
    truth = np.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=np.uint8)
    mask = np.zeros((40, 40), np.uint8)
    mask[10:30, 10:30] = 255
    alpha = (mask / 255).astype(np.float32)
    assert view_scores(ViewPair(truth, alpha, truth, mask))["lpips"] is None
    assert view_scores(ViewPair(truth, alpha, truth, mask), metric)["lpips"] == 0
    worse = view_scores(ViewPair(255 - truth, alpha, truth, mask), metric)["lpips"]
    assert worse is not None and worse > 0
    assert view_scores(ViewPair(truth, alpha, truth, mask * 0), metric)["lpips"] is None
