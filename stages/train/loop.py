"""The loop of a run: steps until the schedule ends; checkpoints, metrics and previews on the way."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

from stages.shared.artifacts import Progress
from stages.shared.artifacts.pictures import encode_png
from stages.shared.errors import BadData
from stages.shared.report import Report
from stages.train import checkpoint, schedule
from stages.train.checkpoint import METRICS_NAME, RunState
from stages.train.config import TrainConfig
from stages.train.monitor import IntervalCallback, preview, preview_views
from stages.train.reporting import StepReport, TensorBoardLogger, mean_losses, metrics_line
from stages.train.tracking.tracker import Interrupted, Tracker
from stages.train.trainer import Trainer

_CHECKPOINT_SECONDS = 60.0
_PREVIEW_SECONDS = 120.0
_STEPS_PER_LINE = 10
_MOST_SKIPPED = 3
_STEPS_PER_LEVELLING = 200  # processes on different machines, or GPUs, may drift apart by rounding
_TRACKING_LIMIT = 0.5  # share of `minutes` after which frames are no longer tracked
_SAVING_SHARE = 10.0  # tracking runs at least this many times as long as saving its checkpoints


def learn(
    trainer: Trainer,
    progress: Progress,
    state: RunState,
    report: Report,
    watch: IntervalCallback | None = None,
    board: TensorBoardLogger | None = None,
) -> None:
    """Steps until the schedule ends; checkpoints, metrics and previews on the way, to a `board` too."""
    config, processes = trainer.config, trainer.processes
    shown = preview_views(trainer.views, trainer.frames)
    pending = checkpoint.unreported_steps(progress)

    def keep() -> None:
        checkpoint.save(progress, trainer, state, pending)

    prefetching = trainer.views.prefetcher.running()
    with _interrupt_flag() as interrupted, processes.failing_together(keep), prefetching:
        _track(trainer, progress, state, interrupted, report)
        report.step("train")
        saved = previewed = time.monotonic()
        _save_preview(trainer, progress, state, shown, board)
        while True:
            turn = processes.turn(state.elapsed, interrupted.is_set())
            state.elapsed = turn.elapsed
            if turn.stop:
                _stop(keep, report, f"step {state.step}")
            if schedule.progress(config, state.step, state.elapsed) >= 1.0:
                break
            started = time.monotonic()
            done = trainer.step(state.step, state.elapsed)
            state.step += 1
            pending.append(done)
            _count_skipped(trainer, progress, state, done, report)
            if state.step % _STEPS_PER_LINE == 0:
                _note(
                    progress,
                    metrics_line(pending, schedule.image_scale(config, _done(trainer, state))),
                    board,
                )
                loss, l1 = mean_losses(pending)
                report.progress(*_position(config, state), loss=loss, l1=l1)
                pending = []
            before, state.elapsed = state.elapsed, state.elapsed + time.monotonic() - started
            if watch is not None:
                watch.after_step(trainer, state.step, before, state.elapsed)
            if state.step % _STEPS_PER_LEVELLING == 0:
                checkpoint.spread(trainer, state)
            if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                keep()
                saved = time.monotonic()
            if time.monotonic() - previewed > _PREVIEW_SECONDS:
                _save_preview(trainer, progress, state, shown, board)
                previewed = time.monotonic()
    keep()
    _save_preview(trainer, progress, state, shown, board)
    if pending:
        _note(progress, metrics_line(pending, schedule.image_scale(config, 1.0)), board)


def _note(progress: Progress, line: dict[str, Any], board: TensorBoardLogger | None) -> None:
    progress.append_line(METRICS_NAME, line)
    if board is not None:
        board.line(line)


def _track(
    trainer: Trainer, progress: Progress, state: RunState, interrupted: threading.Event, report: Report
) -> None:
    """Warm up and track the garments through the take, where that is configured and not yet done.

    A request to stop is answered within one picture. The run then continues with the same frame.
    """
    tracker, processes = trainer.tracker, trainer.processes
    if tracker is None or state.step or state.tracked >= len(tracker.order):
        return
    report.step("track")
    saved, save_seconds = time.monotonic(), 0.0
    counter = _TrackingCounter(trainer, state, interrupted, report)
    while state.tracked < len(tracker.order):
        started, stopped = time.monotonic(), False
        try:
            if processes.first:  # the others wait, and take over what it fits
                if state.tracked < 0:
                    trainer.warm_up(counter.count_step)
                elif _is_late(trainer.config, state):
                    _carry_on(tracker, state, report)
                else:
                    tracker.follow(state.tracked, counter.count_view)
            state.tracked += 1
        except Interrupted:
            stopped = True
        turn = processes.turn(state.elapsed + time.monotonic() - started, stopped or interrupted.is_set())
        state.elapsed = turn.elapsed
        if turn.stop:
            _stop(
                lambda: checkpoint.save(progress, trainer, state),
                report,
                f"frame {max(state.tracked, 0)} of tracking",
            )
        if state.tracked == len(tracker.order) or time.monotonic() - saved > _SAVING_SHARE * save_seconds:
            saving = time.monotonic()
            checkpoint.save(progress, trainer, state)
            saved = time.monotonic()
            save_seconds = saved - saving
    processes.spread(list(trainer.parameters.values()))


def _is_late(config: TrainConfig, state: RunState) -> bool:
    """Whether tracking has taken its share of the time that a run may take."""
    return 0 < _TRACKING_LIMIT * 60.0 * config.minutes < state.elapsed


def _carry_on(tracker: Tracker, state: RunState, report: Report) -> None:
    """Give all frames that are left but one the offsets of the frame before; the caller counts that one."""
    frames = len(tracker.order)
    report.warn(
        f"tracking took half of the time: {frames - state.tracked} of {frames} frames start with the offsets "
        "of the frame before them"
    )
    for place in range(state.tracked, frames):
        tracker.carry(place)
    state.tracked = frames - 1


class _TrackingCounter:
    """Counts the pictures of warm-up and tracking for the progress, and interrupts them on request."""

    def __init__(
        self, trainer: Trainer, state: RunState, interrupted: threading.Event, report: Report
    ) -> None:
        assert trainer.tracker is not None
        self._state, self._interrupted, self._report = state, interrupted, report
        self._per_step = min(trainer.config.views_per_step, len(trainer.cameras))
        self._frames, per_frame = len(trainer.tracker.order), trainer.tracker.units_per_frame
        warm_up = trainer.config.track.warm_up * self._per_step if state.tracked < 0 else 0
        self._total = warm_up + per_frame * (self._frames - max(state.tracked, 0))
        self._done = 0

    def count_step(self) -> None:
        """Before a step of the warm-up."""
        self._count(self._per_step)

    def count_view(self) -> None:
        """Before a picture of a frame."""
        self._count(1)

    def _count(self, pictures: int) -> None:
        if self._interrupted.is_set():
            raise Interrupted
        if self._done:
            self._report.progress(
                min(self._done, self._total), self._total, frame=max(self._state.tracked, 0), of=self._frames
            )
        self._done += pictures


def _stop(save: Callable[[], None], report: Report, place: str) -> NoReturn:
    """Write a checkpoint and end the run."""
    save()
    report.say(f"checkpoint written at {place}")
    raise KeyboardInterrupt


def _done(trainer: Trainer, state: RunState) -> float:
    return schedule.progress(trainer.config, state.step, state.elapsed)


def _position(config: TrainConfig, state: RunState) -> tuple[int, int]:
    """Steps done, and the expected total (the clock may end a run before the steps do)."""
    done = schedule.progress(config, state.step, state.elapsed)
    return state.step, max(state.step, round(state.step / done)) if done > 0 else config.steps


def _count_skipped(
    trainer: Trainer, progress: Progress, state: RunState, done: StepReport, report: Report
) -> None:
    """Warn of a step that was not finite. Three in a row end the run, and leave what repeats them."""
    if done.finite:
        state.skipped_in_a_row = 0
        return
    state.skipped += 1
    state.skipped_in_a_row += 1
    cameras = ", ".join(done.cameras)
    report.warn(f"step {done.step} (frame {done.frame}, {cameras}) gave NaN or infinity and was skipped")
    if state.skipped_in_a_row >= _MOST_SKIPPED:
        terms = {name: value if value == value else None for name, value in done.terms.items()}
        facts = {
            "step": done.step,
            "frame": done.frame,
            "cameras": list(done.cameras),
            "seed": trainer.config.seed,
            "elapsed": state.elapsed,
            "finite_terms": sorted(name for name, value in terms.items() if value is not None),
            "terms_not_finite": sorted(name for name, value in terms.items() if value is None),
        }
        folder = checkpoint.write_repro(progress, trainer, facts)
        raise BadData(
            f"{_MOST_SKIPPED} steps in a row were not finite, the last with frame {done.frame} by {cameras}.",
            folder,
            "Look at that frame's images and pose; or train with another --seed.",
        )


def _save_preview(
    trainer: Trainer,
    progress: Progress,
    state: RunState,
    shown: list[tuple[int, str]],
    board: TensorBoardLogger | None,
) -> None:
    if not trainer.processes.first:
        return
    progress.folder("previews")
    picture = preview(trainer, shown)
    png = encode_png(picture)
    progress.write_bytes(f"previews/step-{state.step:06d}.png", png)
    if board is not None:
        board.picture(png, picture.shape[1], picture.shape[0], state.step)


@contextmanager
def _interrupt_flag() -> Iterator[threading.Event]:
    """Ctrl-C or SIGTERM sets a flag, checked between steps and pictures. A second one stops at once."""
    flag = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return

    def remember(number: int, frame: FrameType | None) -> None:
        if flag.is_set():
            raise KeyboardInterrupt
        flag.set()

    before = {number: signal.signal(number, remember) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
