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

        Says what will be slow and what is broken, each with its cure. The difficult libraries (open3d,
        pymeshlab, CUDA) are tried in child processes, so that a crash is a line here. Ends with exit code 66
        if something that everything needs is broken.

        Where FOLDER is a capture, the capture is checked instead: sharpness, light, masks, calibration, sync
        and coverage of the person by the cameras, a line for each finding.
        """
        from stages.doctor.stage import check_folder, is_capture, run
        from stages.shared.errors import MissingInput

        console = Console(as_json)
        if is_capture(folder):
            findings = check_folder(folder, console)
            for line in findings:
                console.warn(line)
            console.result({"findings": findings} if as_json else {"findings": len(findings)})
            return
        found = run(folder, console)
        if as_json:
            console.result(dataclasses.asdict(found))
        else:
            machine = found.machine
            console.say(f"gw {found.version or 'without a version'}, Python {found.python}, {machine.system}")
            console.say(f"{machine.processor}: {machine.cores} cores, {' '.join(machine.instructions)}")
            memory, free = (value / 2**30 for value in (machine.memory_bytes, machine.free_memory_bytes))
            disk = machine.free_disk_bytes / 2**30
            console.say(f"memory {memory:.1f} GiB, {free:.1f} free; disk {disk:.1f} GiB free")
            there = [f"{name} {version}" for name, version in found.libraries.items() if version]
            console.say("libraries: " + ", ".join(there))
            for check in found.checks:
                console.say(f"{check.name}: {'works' if check.works else check.said}")
            for line in found.slow:
                console.warn(line)
            console.result({}, next_command=None if found.broken else "gw demo -o demo")
        if found.broken:
            others = "; ".join(found.broken[1:]) or "this machine"
            raise MissingInput(found.broken[0], others, "Do what it says, then run gw doctor again.")
