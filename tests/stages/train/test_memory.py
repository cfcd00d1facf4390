"""Memory that does not suffice is said before, and named after."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from stages.shared.errors import UsageProblem
from stages.train import stage
from stages.train.memory import available_bytes, memory_named, say_if_scarce
from stages.train.trainer import Trainer
from tests.listening import Listener
from tests.stages.train.scene import make_subject, tiny


def test_scarce_memory_is_said_and_enough_is_not(tmp_path: Path) -> None:
    heard = Listener()
    assert say_if_scarce(3_000_000_000, 2_000_000_000, heard)
    assert "3.0 GB" in heard.warnings[0] and "2.0 GB" in heard.warnings[0] and "--preset" in heard.warnings[0]
    assert not say_if_scarce(1, 2, heard) and not say_if_scarce(1, None, heard) and len(heard.warnings) == 1
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:   2048 kB\n")
    assert available_bytes(tmp_path / "meminfo") == 2048 * 1024
    assert available_bytes(tmp_path / "none") is None


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        torch.OutOfMemoryError("CUDA out of memory."),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried 9 bytes."),
    ],
)
def test_running_out_names_a_cure(error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Trainer, number: int, elapsed: float) -> None:
        raise error

    monkeypatch.setattr(Trainer, "step", fail)
    with pytest.raises(UsageProblem, match="Memory ran out") as caught:
        stage.run(make_subject(tmp_path), tiny())
    assert "--preset draft" in caught.value.fix


def test_other_errors_stay_what_they_are() -> None:
    with pytest.raises(RuntimeError, match="shapes"), memory_named(1):
        raise RuntimeError("shapes do not fit")
