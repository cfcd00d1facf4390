"""The page of all commands, from the commands themselves: `python -m gw_cli.reference docs/commands.md`."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.main

from gw_cli.app import app
from gw_cli.help import default_text

_HEADER = """# Commands

Made from the commands' own help by `make docs`; a test fails when this page is out of date. Every command
also has `-h`, and ends with 0 done, 2 usage, 65 bad data, 66 missing input, 70 a bug of gw, 74 disk, 75
locked, 130 interrupted. With `--json`, stdout has one JSON object a line, the last one `{"result": {...}}`.
"""


def page() -> str:
    """Markdown of all commands, in the order of `gw --help`."""
    root: Any = typer.main.get_command(app)
    sections = [_section(f"gw {name}", command) for name, command in _leaves(root)]
    contents = [
        f"- [`gw {name}`](#gw-{name.replace(' ', '-')}): {_first(command)}" for name, command in _leaves(root)
    ]
    return "\n".join([_HEADER, *contents, "", *sections])


def _leaves(group: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _leaves(command, f"{before}{name} ")
        elif not command.hidden:
            yield f"{before}{name}", command


def _section(title: str, command: Any) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and p.name != "help"]
    words = " ".join(_place(argument) for argument in arguments)
    lines = [f"## {title}", "", f"    {title} {words} [OPTIONS]".replace("  [", " ["), ""]
    lines += [inspect.cleandoc(command.help or ""), ""]
    if arguments:
        lines += ["| argument | |", "| --- | --- |"]
        lines += [f"| `{_cell(_place(argument))}` | {_cell(argument.help or '')} |" for argument in arguments]
        lines.append("")
    if options:
        lines += ["| option | | default |", "| --- | --- | --- |"]
        lines += [
            f"| {_names(option)} | {_cell(option.help or '')} | {_default(option)} |" for option in options
        ]
        lines.append("")
    return "\n".join(lines)


def _first(command: Any) -> str:
    return inspect.cleandoc(command.help or "").split("\n\n")[0].replace("\n", " ")


def _place(argument: Any) -> str:
    return str(argument.metavar or argument.name.upper())


def _names(option: Any) -> str:
    return ", ".join(f"`{name}`" for name in [*option.opts, *option.secondary_opts])


def _default(option: Any) -> str:
    text = default_text(option)
    return f"`{text}`" if text else "required" if option.required else ""


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page())
