"""`gw clean`: room on the disk."""

from __future__ import annotations

from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json, Subject


def register(app: typer.Typer) -> None:
    @app.command("clean")
    @command
    def clean(
        subject: Subject,
        unused: Annotated[
            bool,
            typer.Option("--unused", help="Artifacts that nothing in use is or came from."),
        ] = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Remove what earlier runs left: artifacts that are neither in use nor an input of one that is.

        No other command removes a finished artifact, so going back to earlier settings costs nothing. Look
        first with --dry-run. The command that made an artifact can make it again.
        """
        from stages.shared.artifacts.unused import remove_unused
        from stages.shared.artifacts.unused import unused as unused_artifacts
        from stages.shared.artifacts.workspace import Workspace
        from stages.shared.errors import UsageProblem

        if not unused:
            raise UsageProblem(
                "Nothing was asked to be removed.", "gw clean", f"Try: gw clean {subject} --unused --dry-run"
            )
        console = Console(as_json)
        workspace = Workspace(subject)
        artifacts = unused_artifacts(workspace) if dry_run else remove_unused(workspace)
        for artifact in artifacts:
            name = artifact.path.relative_to(workspace.root)
            console.say(
                f"{'would remove' if dry_run else 'removed'} {name}, {artifact.bytes / 2**20:.1f} MiB"
            )
        console.result(
            {
                "dry_run": dry_run,
                "artifacts": [str(artifact.path) for artifact in artifacts] if as_json else len(artifacts),
                "bytes": sum(artifact.bytes for artifact in artifacts),
            },
            next_command=("gw", "clean", subject, "--unused") if dry_run and artifacts else None,
        )
