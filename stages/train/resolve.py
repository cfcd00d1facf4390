"""The configuration of a run as method, decoder and parts left out change it."""

from __future__ import annotations

from dataclasses import replace

from stages.shared.avatar.config import NETWORKS
from stages.shared.avatar.decoders.registry import decoder_class
from stages.shared.errors import UsageProblem
from stages.train.ablation import apply_ablation
from stages.train.config import TrainConfig
from stages.train.methods.registry import method_called
from stages.train.window import SMALLEST


def resolve_settings(config: TrainConfig) -> TrainConfig:
    """What can be resolved without the capture; applying it twice changes nothing more.

    Raises:
        UsageProblem: unknown method, decoder or part; settings that exclude each other.
    """
    method, decoder = method_called(config.method), decoder_class(config.model.decoder)
    if 0 < config.patch < SMALLEST:
        raise UsageProblem(
            f"A window of {config.patch} px is too small to learn from.",
            "option --patch",
            f"Give at least {SMALLEST}, or 0 for whole pictures.",
        )
    if config.model.networks not in NETWORKS:
        raise UsageProblem(
            f"No layers are called {config.model.networks!r}.",
            "option --networks",
            f"Choose of {', '.join(NETWORKS)}.",
        )
    track = config.track if decoder.followed else replace(config.track, frame_step=0)
    config = replace(config, model=decoder.resolved(config.model), track=track)
    return apply_ablation(method.resolve(config))
