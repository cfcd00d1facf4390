"""Scores against scikit-image, and against cases that can be counted by hand."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from skimage.transform import downscale_local_mean

from stages.shared.errors import BadData
from stages.shared.metrics.picture import iou, psnr, segmentation_scores, sharpness
from stages.shared.metrics.scores import NAMES, ViewPair, mean_scores, view_scores
from stages.shared.metrics.ssim import ms_ssim, ssim, ssim_in_box


def _pictures(seed: int, height: int = 61, width: int = 47) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    truth = random.integers(0, 256, (height, width, 3))
    prediction = np.clip(truth + random.normal(0, 20, truth.shape), 0, 255)
    return prediction.astype(np.uint8), truth.astype(np.uint8)


@pytest.mark.parametrize("seed", range(3))
def test_psnr_is_that_of_scikit_image(seed: int) -> None:
    prediction, truth = _pictures(seed)
    assert psnr(prediction, truth) == pytest.approx(
        peak_signal_noise_ratio(truth, prediction, data_range=255), abs=1e-9
    )


def test_psnr_of_a_region_ignores_the_rest() -> None:
    prediction, truth = _pictures(1)
    inside = np.zeros(truth.shape[:2], bool)
    inside[5:20, 7:30] = True
    expected = peak_signal_noise_ratio(truth[5:20, 7:30], prediction[5:20, 7:30], data_range=255)
    prediction[~inside] = 0
    assert psnr(prediction, truth, inside) == pytest.approx(expected, abs=1e-9)


def test_psnr_of_equal_and_of_no_pixels() -> None:
    _, truth = _pictures(2)
    assert psnr(truth, truth) == math.inf
    assert psnr(truth, truth, np.zeros(truth.shape[:2], bool)) is None


@pytest.mark.parametrize("seed", range(3))
def test_gaussian_ssim_is_that_of_scikit_image(seed: int) -> None:
    prediction, truth = _pictures(seed)
    expected = structural_similarity(
        truth,
        prediction,
        channel_axis=2,
        data_range=255,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ssim(prediction, truth) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_uniform_ssim_is_that_of_scikit_image(seed: int) -> None:
    prediction, truth = _pictures(seed)
    expected = structural_similarity(
        truth / 255.0, prediction / 255.0, channel_axis=2, data_range=1, win_size=11
    )
    assert ssim(prediction, truth, window="uniform") == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("shape", [(176, 176), (203, 181)])
def test_ms_ssim_is_made_of_the_ssim_of_scikit_image(shape: tuple[int, int]) -> None:
    """With an absurd K1 the luminance is 1, and scikit-image returns contrast times structure alone."""
    prediction, truth = (cv2.GaussianBlur(picture, (0, 0), 2.0) for picture in _pictures(5, *shape))
    options = {"data_range": 255, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = []
    for channel in range(3):
        x, y, product = prediction[..., channel].astype(float), truth[..., channel].astype(float), 1.0
        for scale, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
            if scale:
                x, y = (
                    downscale_local_mean(a[: a.shape[0] // 2 * 2, : a.shape[1] // 2 * 2], 2) for a in (x, y)
                )
            product *= structural_similarity(x, y, K1=0.01 if scale == 4 else 1e9, **options) ** weight
        expected.append(product)
    assert ms_ssim(prediction, truth) == pytest.approx(np.mean(expected), abs=1e-9)
    assert 0 < np.mean(expected) < 1 and ms_ssim(truth, truth) == 1.0


def test_ms_ssim_of_opposite_and_of_small_pictures() -> None:
    _, truth = _pictures(6, 176, 176)
    assert ms_ssim(255 - truth, truth) == 0.0
    assert ms_ssim(truth[:175], truth[:175]) is None


def test_ssim_in_box_is_that_of_the_cut_out() -> None:
    prediction, truth = _pictures(4)
    inside = np.zeros(truth.shape[:2], bool)
    inside[10, 12:40] = True
    inside[10:45, 20] = True
    assert ssim_in_box(prediction, truth, inside) == ssim(prediction[10:45, 12:40], truth[10:45, 12:40])
    assert ssim_in_box(prediction, truth, np.zeros_like(inside)) is None
    assert ssim(prediction[:10], truth[:10]) is None


def test_pictures_that_do_not_match_are_refused() -> None:
    prediction, truth = _pictures(5)
    for wrong in (prediction[1:], prediction.astype(np.float32), prediction[..., 0]):
        with pytest.raises(BadData):
            psnr(wrong, truth)


def test_iou_by_hand() -> None:
    one, other = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    one[:2], other[1:3] = True, True
    assert iou(one, other) == pytest.approx(1 / 3)
    assert iou(one & False, other & False) is None


def test_segmentation_by_hand() -> None:
    truth = np.full((2, 10), 255, np.uint8)
    truth[0] = 3
    truth[1, :4] = 4
    prediction = truth.copy()
    prediction[0, :5] = 4  # half of the upper garment is taken for the lower one
    scores = segmentation_scores(prediction, truth)
    assert scores["miou"] == pytest.approx((5 / 10 + 4 / 9) / 2)
    assert scores["recall"] == pytest.approx(9 / 14)
    assert scores["f1"] == pytest.approx(9 / 14)


def test_segmentation_without_garments_is_unknown() -> None:
    skin = np.zeros((3, 3), np.uint8)
    assert segmentation_scores(skin, skin) == {"miou": None, "recall": None, "f1": None}


def test_sharpness_of_a_stretched_ramp() -> None:
    ramp = np.repeat(np.arange(0, 80, 2, dtype=np.uint8)[None, :, None], 30, 0).repeat(3, 2)
    inside = np.zeros(ramp.shape[:2], bool)
    inside[4:-4, 4:-4] = True
    assert sharpness(ramp // 2, ramp, inside) == pytest.approx(0.25)
    assert sharpness(ramp, ramp, inside) == 1.0
    assert sharpness(ramp, ramp * 0, inside) is None


def test_blur_lowers_sharpness() -> None:
    _, truth = _pictures(6)
    blurred = np.asarray((truth.astype(int) + np.roll(truth, 1, 0) + np.roll(truth, 1, 1)) // 3, np.uint8)
    assert sharpness(blurred, truth, np.ones(truth.shape[:2], bool)) < 0.6


def test_view_scores_of_a_perfect_view_and_means() -> None:
    _, truth = _pictures(7)
    mask = np.zeros(truth.shape[:2], np.uint8)
    mask[10:50, 8:40] = 255
    labels = np.full(mask.shape, 255, np.uint8)
    labels[10:50, 8:20], labels[10:50, 20:40] = 3, 0
    view = ViewPair(truth, (mask / 255).astype(np.float32), truth, mask, labels, labels)
    scores = view_scores(view)
    assert set(scores) == set(NAMES)
    assert scores["ssim_foreground"] == pytest.approx(1) and scores["iou"] == 1 and scores["miou"] == 1
    assert scores["psnr_upper"] == math.inf and scores["psnr_lower"] is None and scores["lpips"] is None
    means = mean_scores([scores, scores | {"iou": 0.5, "psnr_lower": 10.0}])
    assert means["iou"] == 0.75 and means["psnr_lower"] == 10.0
    assert means["psnr_foreground"] is None and means["lpips"] is None
    assert mean_scores([]) == dict.fromkeys(NAMES)


def test_outside_of_the_mask_counts_for_the_silhouette_only() -> None:
    prediction, truth = _pictures(8)
    mask = np.zeros(truth.shape[:2], np.uint8)
    mask[10:50, 8:40] = 255
    stray = prediction.copy()
    stray[mask == 0] = 255
    alpha = np.ones(mask.shape, np.float32)
    clean, dirty = (view_scores(ViewPair(p, alpha, truth, mask)) for p in (prediction, stray))
    for name in ("psnr_foreground", "psnr", "ssim", "ssim_foreground", "sharpness"):
        assert clean[name] == dirty[name], name
    assert clean["iou"] == pytest.approx(40 * 32 / mask.size)
