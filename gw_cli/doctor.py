"""`gw doctor`: what this machine can do, and what is wrong with a capture."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json


def register(app: typer.Typer) -> None:
    @app.command("doctor")
    @command
    def doctor(
        folder: Annotated[
            Path, typer.Argument(help="A capture, or where results would go.", metavar="FOLDER")
        ] = Path(),
        as_json: Json = False,
    ) -> None:
        """Look at this machine: versions, cores, memory, disk, GPU, and whether every library survives use.

        Names what will be slow and what is broken, each with its cure. The libraries that may crash (open3d,
        pymeshlab, CUDA) are tried in child processes. The exit code is 66 if something that every command
        needs is broken.

        If FOLDER is a capture, the capture is checked instead: sharpness, light, masks, calibration,
        synchronisation, and how well the cameras cover the person. Every finding is one line.
        """
        console = Console(as_json)
        console.loading()
        from stages.doctor.stage import check_folder, is_capture, run
        from stages.shared.errors import MissingInput

        if is_capture(folder):
            findings = check_folder(folder, console)
            for line in findings:
                console.warn(line)
            console.result({"findings": findings} if as_json else {"findings": len(findings)})
            return
        diagnosis = run(folder, console)
        if as_json:
            console.result(dataclasses.asdict(diagnosis))
        else:
            machine = diagnosis.machine
            console.say(
                f"gw {diagnosis.version or 'without a version'}, Python {diagnosis.python}, {machine.system}"
            )
            console.say(f"{machine.processor}: {machine.cores} cores, {' '.join(machine.instructions)}")
            memory, free = (value / 2**30 for value in (machine.memory_bytes, machine.free_memory_bytes))
            disk = machine.free_disk_bytes / 2**30
            console.say(f"memory {memory:.1f} GiB, {free:.1f} free; disk {disk:.1f} GiB free")
            libraries = [f"{name} {version}" for name, version in diagnosis.libraries.items() if version]
            console.say("libraries: " + ", ".join(libraries))
            for check in diagnosis.checks:
                console.say(f"{check.name}: {'works' if check.works else check.said}")
            for line in diagnosis.slow:
                console.warn(line)
            console.result({}, next_command=None if diagnosis.broken else ("gw", "demo", "-o", "demo"))
        if diagnosis.broken:
            others = "; ".join(diagnosis.broken[1:]) or "this machine"
            raise MissingInput(
                diagnosis.broken[0], others, "Follow the advice in the error, then run gw doctor again."
            )
