"""One run on several processes (`torchrun`), on one machine or many.

Every process sees the same frame and draws its share of the step's cameras; losses are means over all cameras
of a step, so what the shares give is summed, not averaged. Where one pass of the networks serves all cameras,
the sum is of the gradients of the Gaussians, camera by camera in order: that is less to send than parameters,
and to the bit what one process with all the cameras computes. Where colours see the camera (view
conditioning), it is of the parameters' gradients.

Choices follow from (seed, step) and need no talk; what clocks and signals say (how long the run has lasted,
whether somebody pressed Ctrl-C) the processes agree on between steps, in a message of a fixed form. Every
other exchange comes after such a message, so a process that fails can tell the others whenever they listen.
Only the first process writes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn

from stages.shared.artifacts import Progress
from stages.shared.device import check_device
from stages.shared.errors import GwError
from stages.train.config import LossWeights, TrainConfig

Item = TypeVar("Item")
_PATIENCE = timedelta(hours=1)  # the first process may track a frame, or write the result, for so long
_BUCKET = 16 << 20  # numbers sent at once
_TERMS = (*(field.name for field in fields(LossWeights)), "total")


class OtherStopped(GwError):
    """Another process of the run ended, and this one with it."""

    exit_code = 75

    def __init__(self) -> None:
        super().__init__(
            "Another process of this run stopped.",
            f"process {os.environ.get('RANK', '0')}",
            "Its own message says why; the same command goes on from the last checkpoint.",
        )


@dataclass(frozen=True)
class Turn:
    """What the processes agreed on: s into the run, as the first counts; whether to stop."""

    elapsed: float
    stop: bool


class Processes:
    """The processes of a run as one of them sees them; the only one has nobody to talk to.

    Arguments:
        rank: this one's number. count: of all.
    """

    def __init__(self, rank: int = 0, count: int = 1) -> None:
        self.rank, self.count = rank, count
        self._over = count == 1  # nobody listens, or listens any more

    @property
    def first(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    def share(self, items: Sequence[Item]) -> list[Item]:
        """This process's part; the parts of all are the whole."""
        return list(items[self.rank :: self.count])

    def turn(self, elapsed: float = 0.0, stop: bool = False) -> Turn:
        """Wait for all, and agree.

        Raises:
            OtherStopped: one of them failed or is gone.
        """
        if self._over:
            return Turn(elapsed, stop)
        said = torch.tensor([0.0, float(stop), elapsed if self.first else 0.0], dtype=torch.float64)
        with self._hearing():
            distributed.all_reduce(said)
        failed, stops, seconds = said.tolist()
        if failed:
            self._over = True
            raise OtherStopped
        return Turn(seconds, stops > 0)

    @contextmanager
    def failing_together(self, rescue: Callable[[], None] = lambda: None) -> Iterator[None]:
        """An exception inside the block ends the other processes too; those call `rescue` first."""
        try:
            yield
        except OtherStopped:
            rescue()
            raise
        except BaseException:
            self._tell_failure()
            raise

    def sum_terms(self, terms: dict[str, float]) -> dict[str, float]:
        """Sums of the loss terms of all processes; one that is not finite makes a sum that is not."""
        self.turn()
        values, there = [terms.get(n, 0.0) for n in _TERMS], [float(n in terms) for n in _TERMS]
        facts = torch.tensor([values, there], dtype=torch.float64)
        with self._hearing():
            distributed.all_reduce(facts)
        return {n: v for n, v, t in zip(_TERMS, *facts.tolist(), strict=True) if t > 0}

    def sum_in_order(self, own: Sequence[Tensor], views: int, like: Tensor) -> Tensor:
        """Sum over the views of a step of a row of numbers, `own` those of this process's share.

        Added in the order of the views, as one process does it, so that it is the same sum to the bit: Adam
        makes whole steps even of gradients that are nothing but rounding.
        """
        total = torch.zeros_like(like)
        with self._hearing():
            for view in range(views):
                mine = view % self.count == self.rank
                sent = own[view // self.count] if mine else torch.empty_like(like)
                distributed.broadcast(sent, src=view % self.count)
                total = sent if view == 0 else total + sent
        return total

    def sum_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Sum the gradients of all processes, in place.

        A parameter that some process has a gradient for has one in all, as it would in one process alone.
        """
        parameters = list(parameters)
        touched = torch.tensor([float(parameter.grad is not None) for parameter in parameters])
        with self._hearing():
            distributed.all_reduce(touched)
            gradients: list[Tensor] = []
            for parameter, number in zip(parameters, touched.tolist(), strict=True):
                if number and parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                if number and parameter.grad is not None:
                    gradients.append(parameter.grad)
            for bucket in _buckets(gradients):
                together = torch.cat([gradient.flatten() for gradient in bucket])
                distributed.all_reduce(together)
                parts = together.split([gradient.numel() for gradient in bucket])
                for gradient, part in zip(bucket, parts, strict=True):
                    gradient.copy_(part.view_as(gradient))

    def spread(self, tensors: Sequence[Tensor]) -> None:
        """Give the first process's values to all."""
        if self.count == 1:
            return
        self.turn()
        with self._hearing(), torch.no_grad():
            for tensor in tensors:
                sent = tensor.detach().contiguous()
                distributed.broadcast(sent, src=0)
                tensor.copy_(sent)

    def _tell_failure(self) -> None:
        """Tell the others, who are waiting for a message or soon will be."""
        if self._over:
            return
        self._over = True
        with suppress(RuntimeError):  # they are gone already
            distributed.all_reduce(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))

    @contextmanager
    def _hearing(self) -> Iterator[None]:
        """A connection that breaks means that a process was killed."""
        try:
            yield
        except RuntimeError as error:
            self._over = True
            raise OtherStopped from error
        except BaseException:
            self._over = True  # in the middle of an exchange nothing else can be said
            raise


ALONE = Processes()


@contextmanager
def joined(device: str = "auto") -> Iterator[Processes]:
    """All processes that `torchrun` started; without it, this one alone. `device`: auto, cpu or cuda.

    Inside another such block the processes are the same, as they were at its start.
    """
    count = int(os.environ.get("WORLD_SIZE", "1")) if distributed.is_torchelastic_launched() else 1
    if count == 1:
        yield ALONE
        return
    if distributed.is_initialized():
        yield Processes(distributed.get_rank(), count)
        return
    on_gpus = device != "cpu" and torch.cuda.is_available()
    backend = "cpu:gloo,cuda:nccl" if on_gpus else "gloo"
    if on_gpus:
        torch.cuda.set_device(local_rank())
    distributed.init_process_group(backend, timeout=_PATIENCE)
    processes = Processes(distributed.get_rank(), count)
    try:
        with processes.failing_together():
            yield processes
    finally:
        with suppress(RuntimeError):
            distributed.destroy_process_group()


def local_rank() -> int:
    """Number of this process on its machine: the GPU that it takes."""
    return int(os.environ.get("LOCAL_RANK", "0")) if distributed.is_torchelastic_launched() else 0


def device_called(name: str) -> torch.device:
    """The device of this process: "auto" and "cuda" take a GPU where there is one.

    Raises UsageProblem for an unknown device.
    """
    check_device(name)
    on_gpu = name != "cpu" and torch.cuda.is_available()
    return torch.device("cuda", local_rank()) if on_gpu else torch.device("cpu")


def on_this_machine() -> int:
    """How many processes of the run share this machine's memory."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1")) if distributed.is_torchelastic_launched() else 1


def for_all(config: TrainConfig, processes: Processes) -> TrainConfig:
    """The configuration of one process that would do what these do together: all their cameras a step."""
    return replace(config, views_per_step=config.views_per_step * processes.count)


class Unwritten(Progress):
    """Where every process but the first leaves its work: nowhere."""

    def __init__(self) -> None:
        super().__init__(Path(os.devnull), lambda: None)

    def has(self, name: str) -> bool:
        """Nothing is there."""
        return False

    def folder(self, name: str) -> Path:
        """A name only."""
        return self.path / name

    def write_arrays(self, name: str, arrays: Mapping[str, Any], note: Any = None) -> None: ...

    def write_json(self, name: str, value: Any) -> None: ...

    def write_bytes(self, name: str, data: bytes) -> None: ...

    def append_line(self, name: str, value: Any) -> None: ...

    def rewrite_lines(self, name: str, values: list[Any]) -> None: ...


def _buckets(gradients: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """Gradients in order, in lists of a bounded size."""
    for_now: list[Tensor] = []
    size = 0
    for gradient in gradients:
        if for_now and size + gradient.numel() > _BUCKET:
            yield for_now
            for_now, size = [], 0
        for_now.append(gradient)
        size += gradient.numel()
    if for_now:
        yield for_now
