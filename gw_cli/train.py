"""`gw train`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli import completion
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists, check_inputs_of, check_stages
from gw_cli.options import (
    Device,
    DryRun,
    Force,
    Json,
    Preset,
    Recompute,
    Seed,
    Subject,
    names,
    parse_ranks,
    preset_config,
)
from stages.shared.errors import UsageProblem
from stages.train.ablation import PARTS


def register(app: typer.Typer) -> None:
    @app.command("train")
    @command
    def train(
        subject: Subject,
        preset: Preset = "draft",
        minutes: Annotated[
            float, typer.Option(min=0, help="Stop after this much training time; 0 for the preset's steps.")
        ] = 0.0,
        steps: Annotated[
            int | None, typer.Option(min=1, help="Optimiser steps instead of the preset's.")
        ] = None,
        take: Annotated[
            list[str] | None,
            typer.Option(
                metavar="NAME",
                help="Learn from this training take too, beside the template's; once for each, or all.",
            ),
        ] = None,
        frame_step: Annotated[
            int | None, typer.Option(min=1, help="Learn from every so many-th frame of each take.")
        ] = None,
        views_per_step: Annotated[
            int | None, typer.Option(min=1, help="Cameras splatted for each pass of the networks.")
        ] = None,
        image_scale: Annotated[
            float | None, typer.Option(min=0.05, max=1.0, help="Learn from smaller pictures; 1 is full size.")
        ] = None,
        patch: Annotated[
            int | None,
            typer.Option(
                min=0,
                metavar="PX",
                help="Each step sees a window of PX x PX of every picture at full resolution, drawn where "
                "the person and the edges of garments are; 0 for whole pictures. For large images.",
            ),
        ] = None,
        track_step: Annotated[
            int | None,
            typer.Option(
                min=0,
                help="Follow the garments through every so many-th frame before training, by optical flow "
                "from render to image; 0 to go without.",
            ),
        ] = None,
        history: Annotated[
            int | None,
            typer.Option(
                min=0,
                max=6,
                help="Memories of recent motion (fading in 0.1, 0.3, 0.9 … s) that garments see beside the "
                "pose; 0 for the pose alone. Still poses have no motion.",
            ),
        ] = None,
        decoder: Annotated[
            str,
            typer.Option(
                help="styleunet (the published networks, and anchors) | blendshapes (bases per texel, "
                "driven by the pose: play in real time; without tracking)."
            ),
        ] = "styleunet",
        ranks: Annotated[
            str, typer.Option(help="Of blendshapes: numbers of bases for offsets, colours and form, 24,8,4.")
        ] = "",
        networks: Annotated[
            str,
            typer.Option(help="Which layers have networks: all | garments | none; the preset's if left out."),
        ] = "",
        network_width: Annotated[
            float | None,
            typer.Option(min=0.03125, max=4, help="Multiplier of the networks' widths; 1 is the published."),
        ] = None,
        method: Annotated[
            str,
            typer.Option(
                help="gaussian-wardrobe; or a baseline: animatable-gaussians (one layer, shape kept), layga "
                "(body and one clothing layer on its surface; an approximation)."
            ),
        ] = "gaussian-wardrobe",
        without: Annotated[
            str,
            typer.Option(
                metavar="PARTS",
                help="Ablation: leave out, with commas: "
                + "; ".join(f"{k}, {v}" for k, v in PARTS.items())
                + ".",
            ),
        ] = "",
        from_subject: Annotated[
            Path | None,
            typer.Option(
                metavar="OTHER",
                help="Start from another trained subject, the same person in an inner outfit: its body stays "
                "as it is, the layers that both have go on from there, outer garments are new.",
                autocompletion=completion.subjects,
            ),
        ] = None,
        from_layers: Annotated[
            str,
            typer.Option(
                metavar="LAYERS",
                help="With --from-subject: only these layers, with commas; body alone where the shirt "
                "beneath is another one.",
            ),
        ] = "",
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
        seed: Seed = 0,
        recompute: Recompute = False,
        device: Device = "auto",
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Learn every layer's Gaussians, and how they move with the pose, from the capture's images.

        Reads the maps of `gw bake-maps` and the training take. Ctrl-C writes a checkpoint; the same command
        goes on from there. Losses and times go to metrics.jsonl, previews (truth, render, labels) beside it.
        An outer garment is learned best over a known body: train the inner outfit as a subject of its own
        first, then this one with --from-subject.

        On several processes, also of several machines: torchrun --nproc-per-node 2 -m gw_cli train SUBJECT …
        Each draws --views-per-step cameras of the same frame.
        """
        from stages.train.config import DEFAULT_METHOD, PRESETS

        console = Console(as_json)
        chosen: dict[str, Any] = {
            "steps": steps,
            "frame_step": frame_step,
            "views_per_step": views_per_step,
            "image_scale": image_scale,
            "patch": patch,
        }
        config = replace(
            preset_config(PRESETS, preset),
            seed=seed,
            device=device,
            recompute=recompute,
            minutes=minutes,
            method=method,
            without=names(without),
            takes=tuple(sorted(set(take or ()))),
            from_layers=names(from_layers),
            **{name: value for name, value in chosen.items() if value is not None},
        )
        if track_step is not None:
            config = replace(config, track=replace(config.track, frame_step=track_step))
        if history is not None:
            config = replace(config, model=replace(config.model, history=history))
        shape: dict[str, Any] = {"decoder": decoder, "networks": networks, "width": network_width}
        shape["ranks"] = parse_ranks(ranks) if ranks else None
        config = replace(config, model=replace(config.model, **{k: v for k, v in shape.items() if v}))
        if from_layers and from_subject is None:
            raise UsageProblem(
                "There is no subject to take these layers from.",
                "option --from-layers",
                "Give --from-subject.",
            )
        check_inputs_of("train", subject)
        check_exists(perceptual_weights, "file of weights")
        if from_subject is not None:
            check_stages(from_subject, "train")

        from stages.shared.report import SILENT
        from stages.train import stage
        from stages.train.distributed import joined

        if dry_run:
            console.plan(stage.plan(subject, config, perceptual_weights, from_subject))
            return
        with joined(device) as processes:
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
            next_command=f"gw export-garment {subject} --layer body -o body.gwg"
            if method == DEFAULT_METHOD
            else f"gw evaluate {subject}",
        )


def _short(summary: dict[str, Any]) -> dict[str, Any]:
    """What people are told; costs and what was left out are in the manifest."""
    return {name: value for name, value in summary.items() if name not in ("costs", "left_out")}
