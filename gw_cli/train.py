"""`gw train`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli import completion
from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists, check_inputs_of, check_stages
from gw_cli.options import DryRun, Force, Json, Subject
from stages.shared.errors import UsageProblem
from stages.train.config import DEFAULT_METHOD, PARTS, PRESETS, TrainConfig

_WITHOUT = "Ablation: leave out, with commas: " + "; ".join(f"{k}, {v}" for k, v in PARTS.items()) + "."


def register(app: typer.Typer) -> None:
    @app.command("train")
    @command
    @config_options(PRESETS, "draft", help={"without": _WITHOUT})
    def train(
        subject: Subject,
        take: Annotated[
            list[str] | None,
            typer.Option(
                metavar="NAME",
                help="Learn from this training take as well as the template's; once for each, or all.",
            ),
        ] = None,
        from_subject: Annotated[
            Path | None,
            typer.Option(
                metavar="OTHER",
                help="Start from another trained subject, the same person in an inner outfit: its body stays "
                "as it is, the layers that both have go on from there, outer garments are new.",
                autocompletion=completion.subjects,
            ),
        ] = None,
        perceptual_weights: Annotated[
            Path | None,
            typer.Option(
                metavar="FILE", help="VGG-16 and LPIPS weights, safetensors; without, no LPIPS terms."
            ),
        ] = None,
        tensorboard: Annotated[
            bool,
            typer.Option(
                "--tensorboard",
                help="Also write losses, times and previews to SUBJECT/tensorboard for TensorBoard (extra "
                "tensorboard).",
            ),
        ] = False,
        config: TrainConfig = PRESETS["draft"],
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Learn every layer's Gaussians, and how they move with the pose, from the capture's images.

        Reads the maps of `gw bake-maps` and the training take. Ctrl-C writes a checkpoint; the same command
        goes on from there. Losses and times go to metrics.jsonl, previews (truth, render, labels) next to it.
        An outer garment is learned best over a known body: train the inner outfit as a subject of its own
        first, then this one with --from-subject.

        On several processes, also of several machines: torchrun --nproc-per-node 2 -m gw_cli train SUBJECT …
        Each draws --views-per-step cameras of the same frame.
        """
        console = Console(as_json)
        config = replace(config, takes=tuple(sorted(set(take or ()))))
        if config.from_layers and from_subject is None:
            raise UsageProblem(
                "There is no subject to take these layers from.",
                "option --from-layers",
                "Give --from-subject.",
            )
        check_inputs_of("train", subject)
        check_exists(perceptual_weights, "file of weights")
        if from_subject is not None:
            check_stages(from_subject, "train")

        console.loading()
        from stages.shared.report import SILENT
        from stages.train import stage
        from stages.train.distributed import joined

        if dry_run:
            console.plan(stage.plan(subject, config, perceptual_weights, from_subject))
            return
        with joined(config.device) as processes:
            heard = console if processes.first else SILENT
            result = stage.run(
                subject,
                config,
                heard,
                force=force,
                perceptual_weights=perceptual_weights,
                from_subject=from_subject,
                tensorboard=tensorboard,
                processes=processes,
            )
        if not processes.first:
            return
        console.result(
            {"artifact": result.artifact.path, **result.summary}
            if as_json
            else {"artifact": result.artifact.path, **_short(result.summary)},
            next_command=("gw", "export-garment", subject, "--layer", "body", "-o", "body.gwg")
            if config.method == DEFAULT_METHOD
            else ("gw", "evaluate", subject),
        )


def _short(summary: dict[str, Any]) -> dict[str, Any]:
    """What people read; costs and what was left out are in the manifest."""
    return {name: value for name, value in summary.items() if name not in ("costs", "left_out")}
