"""Reading ahead changes nothing but when pictures are read."""

from __future__ import annotations

import threading
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.pipeline import TRAIN
from stages.shared.artifacts import Workspace
from stages.shared.errors import BadData
from stages.train import stage
from stages.train.stage import prepare
from stages.train.views import Prefetcher
from tests.stages.train.scene import make_subject, tiny


def test_values_are_made_in_order_by_one_thread_that_ends_with_the_block() -> None:
    made: list[tuple[int, str]] = []

    def make(key: int) -> int:
        made.append((key, threading.current_thread().name))
        return 10 * key

    prefetcher: Prefetcher[int, int] = Prefetcher(make)
    prefetcher.schedule([1])
    assert prefetcher.value(1) == 10 and made.pop()[1] == threading.current_thread().name, (
        "not while nobody reads"
    )
    with prefetcher.running():
        prefetcher.schedule([3, 1, 2])
        assert [prefetcher.value(key) for key in (1, 2, 3)] == [10, 20, 30]
        assert [key for key, _ in made] == [3, 1, 2]
        assert all(name.startswith("gw-prefetch") for _, name in made)
        assert prefetcher.value(4) == 40, "what nobody expected is made at once"
        prefetcher.schedule([5, 6])
        prefetcher.schedule([6, 7])
        assert len(prefetcher._pending) == 2, "no more is kept than is expected"
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("gw-prefetch")]
    assert not prefetcher._pending


def test_what_went_wrong_arrives_where_the_value_is_needed() -> None:
    def make(key: int) -> int:
        raise BadData(f"Picture {key} is damaged.", "there", "Copy it.")

    prefetcher: Prefetcher[int, int] = Prefetcher(make)
    with prefetcher.running():
        prefetcher.schedule([1])
        with pytest.raises(BadData, match="Picture 1"):
            prefetcher.value(1)
    with pytest.raises(KeyError), prefetcher.running():
        prefetcher.schedule([2])
        raise KeyError
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("gw-prefetch")]


def test_views_are_the_same_to_the_byte(tmp_path: Path) -> None:
    subject = make_subject(tmp_path)
    plain, ahead = (prepare(subject, tiny(steps=40, coarse_until=0.5)) for _ in range(2))
    with ahead.views.prefetcher.running():
        for step in (0, 19, 20, 39):
            keys = ahead._view_keys(step, 0.0)
            ahead.views.prefetcher.schedule(keys)
            for key in keys:
                expected, found = plain.views.view(*key), ahead.views.view(*key)
                for field in fields(expected):
                    one, other = getattr(expected, field.name), getattr(found, field.name)
                    if isinstance(one, torch.Tensor):
                        assert torch.equal(one, other) and one.dtype == other.dtype, field.name
                assert np.array_equal(expected.camera.intrinsics, found.camera.intrinsics)


def test_a_step_expects_what_the_next_one_sees(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = prepare(make_subject(tmp_path), tiny(steps=40))
    makers: list[str] = []
    made = trainer.views._read

    def noted(*key: object) -> object:
        makers.append(threading.current_thread().name)
        return made(*key)  # type: ignore[arg-type]

    monkeypatch.setattr(trainer.views, "_read", noted)
    with trainer.views.prefetcher.running():
        for step in range(3):
            trainer.step(step, 0.0)
    assert makers and all(name.startswith("gw-prefetch") for name in makers)


def test_a_damaged_picture_is_named_by_the_step_that_needs_it(tmp_path: Path) -> None:
    """It is no step that gave NaN: nothing is skipped, and the earlier steps are kept."""
    subject = make_subject(tmp_path)
    order = prepare(subject, tiny())
    last = order._choice(3).frame  # every frame is seen once in the first four steps
    broken = order.views.sequence.takes[0].view("cam0", last).image
    broken.write_bytes(broken.read_bytes()[:60])
    with pytest.raises(BadData) as caught:
        stage.run(subject, tiny())
    assert caught.value.where == str(broken) and caught.value.fix
    assert Workspace(subject).current(TRAIN) is None
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("gw-prefetch")]
