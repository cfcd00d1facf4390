"""`gw export-garment`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import layers
from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_poses, check_stages
from gw_cli.options import Distilled, DryRun, Json, Preset, Subject, names, one_of, preset_config
from stages.export_garment.config import PRESETS, TemplateMeshConfig
from stages.shared.layers import BODY, LAYERS


def register(app: typer.Typer) -> None:
    @app.command("export-garment")
    @command
    @config_options({"mesh": TemplateMeshConfig()})
    def export_garment(
        subject: Subject,
        layer: Annotated[str, typer.Option(help="body | lower | upper | outer.", autocompletion=layers)],
        output: Annotated[
            Path | None, typer.Option("-o", "--output", help="The file; default: LAYER.gwg.")
        ] = None,
        mesh: Annotated[
            Path | None,
            typer.Option(
                help="Write the template mesh with skeleton and skin weights as glTF (.glb); alone unless -o."
            ),
        ] = None,
        poses: Annotated[
            Path | None, typer.Option(help="With --mesh: a motion that the file carries as animation.")
        ] = None,
        config: TemplateMeshConfig = TemplateMeshConfig(),
        slots: Annotated[
            str,
            typer.Option(
                help="Layers the garment takes up, e.g. lower,upper; default: as segment-layers found."
            ),
        ] = "",
        note: Annotated[str, typer.Option(help="A sentence that goes into the file.")] = "",
        distilled: Distilled = False,
        precision: Annotated[
            str, typer.Option(help="float16 where it costs nothing that can be seen | float32.")
        ] = "float16",
        preset: Preset = "draft",
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Put one trained layer into one file that anybody can wear.

        The file holds numbers only: no code, no paths, no dates. `--layer body` gives the person without
        clothes, who then wears garments in `gw tryon`.

        Examples:

        gw export-garment SUBJECT --layer lower -o skirt.gwg

        gw export-garment SUBJECT --layer lower --mesh skirt.glb --poses walk.bvh

        The mesh opens in Blender and in engines. It has 55 joints with the names of SMPL-X and 8 or 4 weights
        per vertex. Its texture is the layer's map with the learned colours (before training: the projected
        ones). Without maps, or with --no-texture, it has vertex colours. Splat files of a bundle come from
        `gw render --poses canonical --export ply`.
        """
        from stages.shared.errors import UsageProblem

        console = Console(as_json)
        if poses is not None and mesh is None:
            raise UsageProblem(
                "A bundle carries no motion.",
                "option --poses",
                "Leave it out, or add --mesh FILE.glb.",
            )
        one_of("--layer", layer, LAYERS, "layer")
        learned = "distill" if distilled else "train"
        check_stages(subject, learned if mesh is None or output is not None else "segment-layers")
        check_poses([poses])

        console.loading()
        from stages.export_garment import stage, template_mesh

        if mesh is not None:
            shape = replace(config, layer=layer)
            if dry_run:
                planned = template_mesh.plan(subject, mesh, shape, poses)
                if output is None:
                    console.plan(planned)
                    return
            else:
                made = template_mesh.run(subject, mesh, shape, poses, console)
                if output is None:
                    console.result(made)
                    return
        exported = replace(
            preset_config(PRESETS, preset),
            layer=layer,
            slots=names(slots),
            distilled=distilled,
            precision=precision,
            note=note,
        )
        target = output or Path(f"{layer}.gwg")
        if dry_run:
            console.plan(stage.plan(subject, target, exported))
            return
        result = stage.run(subject, target, exported, console)
        shown = {"path": result.path, **result.summary}
        console.result(
            shown, ("gw", "inspect", result.path) if layer != BODY else ("gw", "view", result.path, "--open")
        )
