"""Looking at a run while it learns: somebody is shown the outfit of the moment at given times."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from torch import Tensor

from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.outfit import Outfit
from stages.train.trainer import Trainer


@dataclass
class Watch:
    """When to look, and what to do then; looking does not count as training time and changes nothing.

    Attributes:
        minutes: of training, rising. look: takes the outfit, the due minute, and the number of steps done.
        layer_ids: of a baseline's layers; the stage fills them in.
    """

    minutes: tuple[float, ...]
    look: Callable[[Outfit, float, int], None]
    layer_ids: Mapping[str, Tensor] = field(default_factory=dict)

    def after_step(self, trainer: Trainer, step: int, before: float, elapsed: float) -> None:
        """Look if a time was due between `before` and `elapsed` (s of training); of several, at the last."""
        due = [minute for minute in self.minutes if before < 60 * minute <= elapsed]
        if due:
            with finished_outfit(trainer, self.layer_ids) as outfit:
                self.look(outfit, due[-1], step)


@contextmanager
def finished_outfit(trainer: Trainer, layer_ids: Mapping[str, Tensor]) -> Iterator[Outfit]:
    """The outfit as it would be if training ended now; afterwards the models are as they were."""
    models = trainer.models
    kept = {name: {k: v.clone() for k, v in model.named_buffers()} for name, model in models.items()}
    trainer.finish()
    for model in models.values():
        model.eval()
    try:
        layers = tuple(
            WornLayer(name, (), model.maps, model, layer_ids=layer_ids.get(name))
            for name, model in models.items()
        )
        yield Outfit(trainer.views.body, trainer.views.poses.betas, layers)
    finally:
        for name, model in models.items():
            model.train()
            for key, buffer in model.named_buffers():
                buffer.copy_(kept[name][key])
