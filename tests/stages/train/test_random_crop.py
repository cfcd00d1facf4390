"""Windows of large pictures: exact cut-outs, drawn by seed and step where there is something to learn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from stages.shared.avatar.compose import compose
from stages.shared.errors import UsageProblem
from stages.shared.losses.perceptual import face_box
from stages.train import stage
from stages.train.objective import picture_terms, render
from stages.train.random_crop import RandomCrop, boundaries
from stages.train.resolve import resolve_settings
from stages.train.trainer import Trainer
from stages.train.views import choose
from tests.stages.train.scene import make_subject, tiny

_BACKGROUND = 250


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("windows"))


def _layers(height: int = 300, width: int = 200) -> np.ndarray:
    """A person in the lower left corner: a body and a garment."""
    layer = np.full((height, width), _BACKGROUND, np.uint8)
    layer[180:280, 10:70] = 0
    layer[180:230, 10:70] = 1
    return layer


def test_a_window_is_the_cut_out_of_the_whole(subject: Path) -> None:
    trainer = stage.prepare(subject, tiny())
    with torch.no_grad():
        composite = compose(trainer.posed(1))
    whole = trainer.views.view(1, "cam1")
    seen = render(composite, whole.camera, body_alone=True)
    layer = trainer.views._crop(1, "cam1").layer
    places = set()
    for step in range(6):
        window = RandomCrop(12, (0, 5, step))
        left, top, right, bottom = window.box(layer, _BACKGROUND)
        places.add((left, top))
        cut = (slice(top, bottom), slice(left, right))
        part = trainer.views.view(1, "cam1", random_crop=window)
        assert (part.camera.width, part.camera.height) == (12, 12) == (right - left, bottom - top)
        for name in ("image", "inside", "valid", "labels", "known", "silhouette"):
            assert torch.equal(getattr(part, name), getattr(whole, name)[cut]), name
        picture = render(composite, part.camera, body_alone=True)
        assert picture.alpha.max() > 0.5
        for name in ("color", "labels", "alpha", "expected_depth"):
            assert torch.allclose(getattr(picture, name), getattr(seen, name)[cut], atol=2e-4), name
        assert torch.allclose(picture.layers[0].alpha, seen.layers[0].alpha[cut], atol=2e-4)
    assert len(places) > 2


def test_a_window_of_a_smaller_picture_is_cut_from_the_smaller_picture(subject: Path) -> None:
    views = stage.prepare(subject, tiny()).views
    small, window = views.view(2, "cam0", 0.5), RandomCrop(8, (3, 5, 1))
    part = views.view(2, "cam0", 0.5, window)
    offset = small.camera.intrinsics[:2, 2] - part.camera.intrinsics[:2, 2]
    left, top = offset.round().astype(int)
    assert np.allclose(offset, [left, top]) and part.image.shape == (8, 8, 3)
    assert torch.equal(part.image, small.image[top : top + 8, left : left + 8])


def test_the_draw_is_a_function_of_its_key_and_goes_by_person_and_boundaries() -> None:
    layer = _layers()
    boxes = [RandomCrop(64, (1, 5, step)).box(layer, _BACKGROUND) for step in range(300)]
    assert boxes == [RandomCrop(64, (1, 5, step)).box(layer, _BACKGROUND) for step in range(300)]
    assert len(set(boxes)) > 20
    parts = [layer[top:bottom, left:right] for left, top, right, bottom in boxes]
    assert all(part.shape == (64, 64) for part in parts)
    foreground = [(part != _BACKGROUND).mean() for part in parts]
    anywhere = (layer != _BACKGROUND).mean()
    assert min(foreground) > 0 and np.mean(foreground) > 3 * anywhere
    lines = [boundaries(part).mean() for part in parts]
    assert np.mean(lines) > 3 * boundaries(layer).mean()
    shares = np.zeros(layer.shape)
    for left, top, right, bottom in boxes:
        shares[top:bottom, left:right] += 1
    assert (shares[layer != _BACKGROUND] > 0).all(), "no part of the person is left out for ever"


@pytest.mark.parametrize("shape", [(40, 100), (100, 40), (40, 40), (64, 64)])
def test_views_smaller_than_the_window_are_seen_whole(shape: tuple[int, int]) -> None:
    layer = _layers(300, 200)[150 : 150 + shape[0], : shape[1]]
    left, top, right, bottom = RandomCrop(64, (0,)).box(layer, _BACKGROUND)
    assert (right - left, bottom - top) == (min(64, shape[1]), min(64, shape[0]))


def test_a_view_of_nothing_has_windows_too() -> None:
    nobody = np.full((200, 200), _BACKGROUND, np.uint8)
    boxes = {RandomCrop(64, (0, step)).box(nobody, _BACKGROUND) for step in range(40)}
    assert len(boxes) > 10


def test_outlines_are_where_layers_meet() -> None:
    layer = np.array([[9, 9, 9], [9, 0, 1], [9, 0, 0]], np.uint8)
    assert boundaries(layer).tolist() == [[0, 1, 1], [1, 1, 1], [1, 0, 0]]


def test_a_patch_that_covers_everything_changes_nothing(subject: Path) -> None:
    reports, weights = [], []
    for patch in (0, 64):
        trainer = stage.prepare(subject, tiny(patch=patch))
        reports.append([trainer.step(number, 0.0) for number in (0, 1)])
        weights.append({name: p.detach().clone() for name, p in trainer.parameters.items()})
    for plain, patched in zip(*reports, strict=True):
        assert plain.terms == patched.terms and plain.gradient_norm == patched.gradient_norm
    assert all(torch.equal(weights[1][name], values) for name, values in weights[0].items())


def test_steps_see_windows_by_seed_and_number_whatever_came_before(subject: Path) -> None:
    config = tiny(patch=32, seed=3)
    one, other = stage.prepare(subject, config), stage.prepare(subject, config)
    other._random_crop(choose(3, 0, other.frames, other.cameras, 2), "cam0")
    assert _terms(one, 5) == _terms(other, 5)
    assert _terms(one, 5) != _terms(stage.prepare(subject, tiny(seed=3)), 5)


def _terms(trainer: Trainer, step: int) -> dict[str, float]:
    """The terms of a step without doing it."""
    choice = choose(trainer.config.seed, step, trainer.frames, trainer.cameras, 2)
    found: dict[str, float] = {}
    with torch.no_grad():
        composite = compose(trainer.posed(choice.frame))
        for camera in choice.cameras:
            view = trainer.views.view(choice.frame, camera, random_crop=trainer._random_crop(choice, camera))
            background = torch.full((3,), 0.5)
            terms = picture_terms(composite, view, background, trainer.config.weights, "l1")
            found |= {f"{camera} {name}": float(value) for name, value in terms.items()}
    assert all(np.isfinite(value) for value in found.values())
    return found


def test_the_face_term_is_off_where_the_window_shows_no_face(subject: Path) -> None:
    view = stage.prepare(subject, tiny()).views.view(0, "cam0")
    camera = view.camera.scaled(8)
    centre = camera.centre + camera.world_from_camera[:3, 2] * 2.0
    whole = face_box(camera, centre)
    assert whole is not None
    left, top, right, bottom = whole
    assert face_box(camera.crop((left, top, right, bottom)), centre) == (0, 0, right - left, bottom - top)
    assert face_box(camera.crop((0, 0, left + 4, camera.height)), centre) is None


def test_too_small_a_window_is_refused() -> None:
    with pytest.raises(UsageProblem, match="too small"):
        resolve_settings(tiny(patch=20))
