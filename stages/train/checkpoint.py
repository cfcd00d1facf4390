"""State of an unfinished run in one file: weights, Adam's moments, and the step they are of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from stages.shared.artifacts import Progress
from stages.shared.errors import BadData
from stages.shared.report import Report
from stages.train.reporting import StepReport
from stages.train.trainer import Trainer

CHECKPOINT_NAME = "checkpoint.safetensors"
METRICS_NAME = "metrics.jsonl"


@dataclass
class RunState:
    """Where a run stands.

    Attributes:
        tracked: frames tracked so far, −1 before the warm-up. step: next step to do. elapsed: seconds
        trained so far. skipped: steps that were not finite. skipped_in_a_row: the latest of them.
    """

    tracked: int = -1
    step: int = 0
    elapsed: float = 0.0
    skipped: int = 0
    skipped_in_a_row: int = 0


def save(
    progress: Progress, trainer: Trainer, state: RunState, unreported: Sequence[StepReport] = ()
) -> None:
    """Replace the checkpoint; bit-exact, so that a resumed run gives the same weights (on a CPU).

    `unreported`: steps that no line of the metrics covers yet.
    """
    arrays = {}
    for name, parameter in trainer.parameters.items():
        arrays[f"value.{name}"] = parameter.detach().cpu().numpy()
        moments = trainer.optimizer.state.get(parameter)
        if moments:
            arrays[f"first.{name}"] = moments["exp_avg"].cpu().numpy()
            arrays[f"second.{name}"] = moments["exp_avg_sq"].cpu().numpy()
            arrays[f"count.{name}"] = moments["step"].cpu().numpy().reshape(1)
    if trainer.tracker is not None and not state.step:
        for name, layer in trainer.tracker.tracked.items():
            arrays[f"tracked.{name}"] = layer.control_points.numpy()
    steps = [
        asdict(step) if step.finite else {**asdict(step), "terms": {}, "gradient_norm": 0.0}
        for step in unreported
    ]
    progress.write_arrays(CHECKPOINT_NAME, arrays, {**vars(state), "unreported": steps})


def unreported_steps(progress: Progress) -> list[StepReport]:
    """The steps that no line of the metrics covered when the checkpoint was written; [] without one."""
    if not progress.has(CHECKPOINT_NAME):
        return []
    _, note = progress.arrays(CHECKPOINT_NAME)
    return [StepReport(**{**step, "cameras": tuple(step["cameras"])}) for step in note.get("unreported", [])]


def restore(progress: Progress, trainer: Trainer) -> RunState:
    """Read the checkpoint, or start at step 0 when there is none. Later lines of the metrics are dropped.

    Raises:
        BadData: the checkpoint is damaged or of other models.
    """
    if not progress.has(CHECKPOINT_NAME):
        return RunState()
    arrays, note = progress.arrays(CHECKPOINT_NAME)
    note.pop("unreported", None)
    state = RunState(**note)
    for name, parameter in trainer.parameters.items():
        value = arrays.get(f"value.{name}")
        if value is None or value.shape != tuple(parameter.shape):
            raise BadData(
                f"The checkpoint does not fit this model ({name}).",
                str(progress.path / CHECKPOINT_NAME),
                "Run the same command with --force to start again.",
            )
        parameter.data.copy_(torch.from_numpy(value))
        if f"first.{name}" in arrays:
            count = torch.from_numpy(arrays[f"count.{name}"])[0]
            trainer.optimizer.state[parameter] = {
                "step": count.to(parameter.device) if parameter.is_cuda else count.clone(),
                "exp_avg": torch.from_numpy(arrays[f"first.{name}"]).to(parameter.device),
                "exp_avg_sq": torch.from_numpy(arrays[f"second.{name}"]).to(parameter.device),
            }
    for name, layer in trainer.tracker.tracked.items() if trainer.tracker is not None else ():
        if f"tracked.{name}" in arrays:
            layer.control_points.copy_(torch.from_numpy(arrays[f"tracked.{name}"]))
    lines = [line for line in progress.lines(METRICS_NAME) if line["step"] < state.step]
    progress.rewrite_lines(METRICS_NAME, lines)
    return state


def resume(progress: Progress, trainer: Trainer, report: Report) -> RunState:
    """The state of an interrupted run in all processes, or of a new one; tells where the run continues."""
    state = restore(progress, trainer)
    spread(trainer, state)
    if state.step:
        report.say(f"going on from step {state.step}")
    elif state.tracked > 0:
        report.say(f"going on from frame {state.tracked} of tracking")
    return state


def spread(trainer: Trainer, state: RunState) -> None:
    """Copy the state of the first process to all others, to the bit."""
    processes, optimizer = trainer.processes, trainer.optimizer
    if processes.count == 1:
        return
    numbers = torch.tensor(list(vars(state).values()), dtype=torch.float64)
    learned = torch.tensor([float(p in optimizer.state) for p in trainer.parameters.values()])
    buffers = [buffer for model in trainer.models.values() for buffer in model.buffers()]
    processes.spread([numbers, learned, *trainer.parameters.values(), *buffers])
    for (name, value), number in zip(vars(state).items(), numbers.tolist(), strict=True):
        setattr(state, name, type(value)(number))
    moments: list[Tensor] = []
    for parameter, is_learned in zip(trainer.parameters.values(), learned.tolist(), strict=True):
        if is_learned and parameter not in optimizer.state:
            step = torch.zeros((), device=parameter.device if parameter.is_cuda else "cpu")
            first, second = torch.zeros_like(parameter), torch.zeros_like(parameter)
            optimizer.state[parameter] = {"step": step, "exp_avg": first, "exp_avg_sq": second}
        if is_learned:
            moments += optimizer.state[parameter].values()
    processes.spread(moments)


def write_repro(progress: Progress, trainer: Trainer, report: dict[str, object]) -> str:
    """Write what is needed to repeat a step that was not finite; returns the folder."""
    folder = progress.folder("repro")
    progress.write_json("repro/step.json", report)
    arrays = {name: p.detach().cpu().numpy() for name, p in trainer.parameters.items()}
    progress.write_arrays("repro/weights.safetensors", arrays, report)
    return str(folder)
