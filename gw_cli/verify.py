"""`gw verify`: is every byte still what was written?"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import artifacts
from gw_cli.console import Console, command
from gw_cli.options import Json

_OTHER_SPLATS = (".splat", ".ksplat", ".sog", ".spx", ".lcc")


def register(app: typer.Typer) -> None:
    @app.command("verify")
    @command
    def verify(
        path: Annotated[
            Path,
            typer.Argument(
                metavar="PATH",
                help="Workspace folder of a subject, a bundle (.gwg), or a splat file (.ply, .spz, .glb).",
                autocompletion=artifacts,
            ),
        ],
        as_json: Json = False,
    ) -> None:
        """Read everything and compare it with the digests it was written with: a subject, or a .gwg bundle.

        A splat file of any program is examined instead: whether it is complete, whether every number is
        possible, and what it shows. The exit code is 65 if anything is damaged. Nothing is changed.
        """
        from stages.shared.artifacts.verify import verify as verify_workspace
        from stages.shared.artifacts.workspace import Workspace
        from stages.shared.errors import BadData

        console = Console(as_json)
        if path.suffix == ".gwg":
            from stages.shared.artifacts.bundle import read_bundle

            bundle = read_bundle(path)
            from stages.shared.outfit.layer import check_bundle_model  # needs torch: a damaged file does not

            check_bundle_model(bundle, str(path))
            console.result({"bundle": str(path), "digest": bundle.digest, "damaged": []})
            return
        if path.suffix in (".ply", ".spz", ".glb"):
            from stages.shared.export.splats import splat_facts

            console.result({"splats": str(path), **splat_facts(path), "damaged": []})
            return
        if path.suffix.lower() in _OTHER_SPLATS and path.is_file():
            raise BadData(
                f"Splat files of the kind {path.suffix} are not read.",
                str(path),
                f"Convert it: splat-transform {path.name} {path.stem}.ply",
            )
        report = verify_workspace(Workspace(path))
        for damage in report.damaged:
            console.warn(f"{damage.path}: {damage.what}")
        console.result(
            dataclasses.asdict(report) if as_json else _counts(report.artifacts, report.files, report.bytes)
        )
        if report.damaged:
            first = report.damaged[0]
            raise BadData(
                f"{len(report.damaged)} damaged: {first.what}".rstrip(".") + ".",
                str(first.path),
                f"Run `gw status {path}`; it says which stage to run again.",
            )


def _counts(artifacts: int, files: int, size: int) -> dict[str, int]:
    return {"artifacts": artifacts, "files": files, "bytes": size}
