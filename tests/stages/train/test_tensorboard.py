"""Event files for TensorBoard say what metrics.jsonl says, and change nothing of what is learned."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import shutil
import signal
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stages.shared.artifacts import Workspace
from stages.shared.errors import MissingInput
from stages.train import stage
from stages.train.reporting import StepReport
from stages.train.trainer import Trainer
from tests.listening import Listener
from tests.stages.train.scene import make_subject, tiny

_NOT_INSTALLED = "needs the extra: pip install '.[tensorboard]'"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("board")).parent


@pytest.fixture
def subject(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared, tmp_path / "copy")
    return tmp_path / "copy" / "subject"


def _events(folder: Path) -> list[Any]:
    """All events of a folder's files, in order, read by the format of TFRecord files and their checksums."""
    events = importlib.import_module("tensorboardX.proto.event_pb2")
    found = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        found += [events.Event.FromString(record) for record in _records(path.read_bytes())]
    return found


def _records(data: bytes) -> Iterator[bytes]:
    place = 0
    while place < len(data):
        length, check = struct.unpack_from("<QI", data, place)
        assert check == _masked_crc(data[place : place + 8])
        record = data[place + 12 : place + 12 + length]
        assert struct.unpack_from("<I", data, place + 12 + length)[0] == _masked_crc(record)
        yield record
        place += 16 + length


def _masked_crc(data: bytes) -> int:
    """CRC-32C (Castagnoli), turned and shifted as TFRecord has it."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 * (crc & 1))
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def test_events_say_what_the_metrics_say_and_change_nothing(subject: Path, tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX", reason=_NOT_INSTALLED)
    shutil.copytree(subject.parent, tmp_path / "plain")
    plain = stage.run(tmp_path / "plain" / "subject", tiny(steps=12)).artifact
    heard = Listener()
    shown = stage.run(subject, tiny(steps=12), heard, tensorboard=True).artifact
    assert shown.key == plain.key
    for layer in ("body", "upper"):
        for name, values in plain.arrays(layer).items():
            assert np.array_equal(shown.arrays(layer)[name], values), name

    folder = subject / "tensorboard" / f"train-{shown.key}"
    events = _events(folder)
    scalars = {
        (event.step, value.tag): value.simple_value
        for event in events
        for value in event.summary.value
        if value.tag != "preview"
    }
    lines = [json.loads(line) for line in shown.record("metrics.jsonl").splitlines()]
    assert {step for step, _ in scalars} == {line["step"] for line in lines}
    for line in lines:
        for group in ("losses", "seconds"):
            for name, value in line[group].items():
                assert scalars[line["step"], f"{group}/{name}"] == pytest.approx(value, rel=1e-6)
        assert scalars[line["step"], "gradient_norm"] == pytest.approx(line["gradient_norm"], rel=1e-6)
    pictures = [(e.step, v.image) for e in events for v in e.summary.value if v.tag == "preview"]
    assert [step for step, _ in pictures] == [0, 12]
    for step, image in pictures:
        encoded = shown.record(f"previews/step-{step:06d}.png")
        assert image.encoded_image_string == encoded
        decoded = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None and decoded.shape[:2] == (image.height, image.width)
    assert not list(Workspace(subject).root.glob("train/*/events*")), "the artifact has no part in it"


def test_a_resumed_run_says_from_which_step_its_events_count(
    subject: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("tensorboardX", reason=_NOT_INSTALLED)
    step = Trainer.step

    def interrupted(self: Trainer, number: int, elapsed: float) -> StepReport:
        if number == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, number, elapsed)

    monkeypatch.setattr(Trainer, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stage.run(subject, tiny(steps=6), tensorboard=True)
    monkeypatch.undo()
    done = stage.run(subject, tiny(steps=6), tensorboard=True)
    folders = list((subject / "tensorboard").iterdir())
    assert [folder.name for folder in folders] == [f"train-{done.artifact.key}"]
    starts = [event.step for event in _events(folders[0]) if event.HasField("session_log")]
    assert starts == [0, 4]


def test_without_the_package_a_run_is_refused_before_it_starts(
    subject: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "tensorboardX" else find(name, *rest)
    )
    with pytest.raises(MissingInput) as caught:
        stage.run(subject, tiny(steps=1), tensorboard=True)
    assert (
        "gaussian-wardrobe[tensorboard]" in caught.value.fix and caught.value.where == "option --tensorboard"
    )
    assert not (subject / "tensorboard").exists() and not list(subject.glob(".train*"))
