"""Two small stages as a process of its own, to be killed: `python -m tests.crash.fake_stage SUBJECT CAPTURE`.

The first writes files of every kind; the second is resumable. Nothing heavy is imported, so that a process
starts in a fifth of a second. With `--kill-at N` the process kills itself at the N-th call of the file layer,
before the call (`--moment before`), after it, or in the middle of a write.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.shared.artifacts import Artifact, ExternalFiles, StageSpec, Workspace
from stages.shared.artifacts.files import FileLayer, using_layer
from stages.shared.errors import GwError

PREPARE = StageSpec("prepare", "gw prepare CAPTURE -o SUBJECT", ())
LEARN = StageSpec("learn", "gw learn SUBJECT", ("prepare",))
STEPS = 8
STEPS_PER_CHECKPOINT = 2


@dataclass(frozen=True)
class Config:
    size: int = 500
    seed: int = 1


class CountingLayer(FileLayer):
    """Tells the kind of every call, in order, to `before` and `after`.

    Does not wait for the disk: the system keeps what a killed process wrote, and tests have no power cuts.
    """

    def __init__(self) -> None:
        self.calls: list[str] = []

    def before(self, kind: str) -> None:
        self.calls.append(kind)

    def after(self, kind: str) -> None:
        """Called when a call has returned."""

    def create(self, path: Path) -> int:
        self.before("create")
        descriptor = super().create(path)
        self.after("create")
        return descriptor

    def append(self, path: Path) -> int:
        self.before("append")
        descriptor = super().append(path)
        self.after("append")
        return descriptor

    def write(self, descriptor: int, data: memoryview) -> int:
        self.before("write")
        count = super().write(descriptor, data)
        self.after("write")
        return count

    def flush(self, descriptor: int) -> None:
        self.before("flush")
        self.after("flush")

    def flush_folder(self, path: Path) -> None:
        self.before("flush_folder")
        self.after("flush_folder")

    def rename(self, source: Path, target: Path) -> None:
        self.before("rename")
        super().rename(source, target)
        self.after("rename")

    def make_folder(self, path: Path) -> None:
        self.before("make_folder")
        super().make_folder(path)
        self.after("make_folder")


class FailingLayer(CountingLayer):
    """The operating system refuses one call."""

    def __init__(self, at: int, code: int) -> None:
        super().__init__()
        self.at, self.code = at, code

    def before(self, kind: str) -> None:
        super().before(kind)
        if len(self.calls) - 1 == self.at:
            raise OSError(self.code, "injected")


class KillingLayer(CountingLayer):
    """SIGKILL to this very process at one call: no handler runs, no buffer is written."""

    def __init__(self, at: int, moment: str) -> None:
        super().__init__()
        self.at, self.moment = at, moment

    def _now(self) -> bool:
        return len(self.calls) - 1 == self.at

    def before(self, kind: str) -> None:
        super().before(kind)
        if self._now() and (self.moment == "before" or (self.moment == "inside" and kind != "write")):
            os.kill(os.getpid(), signal.SIGKILL)

    def after(self, kind: str) -> None:
        if self._now():
            os.kill(os.getpid(), signal.SIGKILL)

    def write(self, descriptor: int, data: memoryview) -> int:
        half = self.moment == "inside" and len(self.calls) == self.at
        return super().write(descriptor, data[: len(data) // 2] if half else data)


def prepare(workspace: Workspace, capture: Path, config: Config, force: bool = False) -> Artifact:
    inputs = {"capture/images": ExternalFiles("capture/images", capture, sorted(capture.glob("*.png")))}
    artifact = None if force else workspace.find(PREPARE, config, inputs)
    if artifact is None:
        random = np.random.default_rng(config.seed)
        with workspace.build(PREPARE, config, inputs, force=force) as build:
            build.write_arrays("template", {"vertices": random.random((config.size, 3), np.float32)})
            build.write_picture("overlay.png", np.zeros((8, 8, 3), np.uint8))
            build.write_bytes("film.mp4", b"film" * 100)
            build.summary(vertices=config.size)
        artifact = build.artifact
    workspace.publish(artifact, "overlay.png", "overlay.png")
    return artifact


def learn(
    workspace: Workspace, prepared: Artifact, config: Config, force: bool = False
) -> tuple[Artifact, int]:
    """The artifact, and how many steps this run computed."""
    inputs = {"prepare": prepared}
    found = None if force else workspace.find(LEARN, config, inputs)
    if found is not None:
        return found, 0
    with workspace.progress(LEARN, config, inputs, force=force) as progress:
        weights, start = np.zeros(config.size), 0
        if progress.has("checkpoint.safetensors"):
            arrays, start = progress.arrays("checkpoint.safetensors")
            weights = arrays["weights"]
        progress.rewrite_lines("metrics.jsonl", progress.lines("metrics.jsonl")[:start])
        for step in range(start, STEPS):
            weights = weights * 0.9 + np.random.default_rng((config.seed, step)).random(config.size)
            progress.append_line("metrics.jsonl", {"step": step, "mean": float(weights.mean())})
            if (step + 1) % STEPS_PER_CHECKPOINT == 0:
                progress.write_arrays("checkpoint.safetensors", {"weights": weights}, step + 1)
        lines = progress.lines("metrics.jsonl")
        with workspace.build(LEARN, config, inputs, force=force) as build:
            build.write_arrays("lower", {"weights": weights})
            build.write_json("metrics", lines)
    return build.artifact, STEPS - start


def run(subject: Path, capture: Path, config: Config = Config(), force: bool = False) -> tuple[str, str, int]:
    """Digests of both artifacts, and the steps computed."""
    workspace = Workspace(subject)
    workspace.save_settings(capture=capture)
    prepared = prepare(workspace, capture, config, force)
    learnt, steps = learn(workspace, prepared, config, force)
    return prepared.digest, learnt.digest, steps


def wait_for(path: Path, seconds: float) -> None:
    """Wait until a file is there, at most so long."""
    end = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.001)


def hold(subject: Path, seconds: float, gate: Path | None) -> None:
    """Be the writer for a while; with a gate from when the file `begin` is in it until `end` is."""
    if gate is not None:
        wait_for(gate / "begin", seconds)
    workspace = Workspace(subject)
    with workspace.build(PREPARE, Config(), {}) as build:
        sys.stdout.write("holding\n")
        sys.stdout.flush()
        if gate is not None:
            wait_for(gate / "end", seconds)
        else:
            time.sleep(seconds)
        build.write_arrays("template", {"vertices": np.zeros((3, 3))})


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("subject", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--kill-at", type=int)
    parser.add_argument("--moment", default="before", choices=["before", "inside", "after"])
    parser.add_argument("--force", action="store_true")
    parser.add_argument("--hold", type=float, default=0)
    parser.add_argument("--gate", type=Path)
    options = parser.parse_args()
    layer = (
        contextlib.nullcontext()
        if options.kill_at is None
        else using_layer(KillingLayer(options.kill_at, options.moment))
    )
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    try:
        with layer:
            if options.hold:
                hold(options.subject, options.hold, options.gate)
            else:
                run(options.subject, options.capture, force=options.force)
    except GwError as error:
        sys.stderr.write(f"{error.what} {error.where}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
