"""The page of all commands, from the commands themselves: `python -m gw_cli.reference docs/commands.md`."""

from __future__ import annotations

import inspect
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.main

from gw_cli.app import app
from gw_cli.help import default_text

_HEADER = """# Commands

`make docs` writes this page from the help of the commands. A test fails when it is out of date.

Exit codes: 0 done, 2 usage, 65 bad data, 66 missing input, 70 a bug of gw, 74 disk, 75 locked,
130 interrupted.
With `--json`, stdout has one JSON object per line. The last one is `{"result": {...}}`, or
`{"error": {"what", "where", "fix", "exit_code"}}`.
"""
_SHARED = 5
"""An option that this many commands have with the same help is explained once."""


def page() -> str:
    """Markdown of all commands, in the order of `gw --help`."""
    root: Any = typer.main.get_command(app)
    commands = list(_leaves(root))
    shared = _shared_options([command for _, command in commands])
    contents = [
        f"- [`gw {name}`](#gw-{name.replace(' ', '-')}): {_first(command)}" for name, command in commands
    ]
    sections = [_section(f"gw {name}", command, shared) for name, command in commands]
    return "\n".join([_HEADER, *contents, "", _shared_section(shared), *sections])


def _options(command: Any) -> list[Any]:
    return [p for p in command.params if p.param_type_name == "option" and p.name != "help"]


def _shared_options(commands: list[Any]) -> dict[tuple[str, str], str]:
    """(names, help) of options that many commands have, with the name that stands for them."""
    counts = Counter(
        (_names(option), option.help or "") for command in commands for option in _options(command)
    )
    return {key: key[0].split(", ")[0] for key, count in counts.items() if count >= _SHARED}


def _shared_section(shared: dict[tuple[str, str], str]) -> str:
    lines = [
        "## Options of many commands",
        "",
        "| option | |",
        "| --- | --- |",
        "| `-h`, `--help` | Show the help. |",
    ]
    lines += [f"| {names} | {_cell(text)} |" for names, text in shared]
    return "\n".join([*lines, ""])


def _leaves(group: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _leaves(command, f"{before}{name} ")
        elif not command.hidden:
            yield f"{before}{name}", command


def _section(title: str, command: Any, shared: dict[tuple[str, str], str]) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    words = " ".join(_place(argument) for argument in arguments)
    lines = [f"## {title}", "", f"    {title} {words} [OPTIONS]".replace("  [", " ["), ""]
    lines += [inspect.cleandoc(command.help or ""), ""]
    if arguments:
        lines += ["| argument | |", "| --- | --- |"]
        lines += [f"| `{_cell(_place(argument))}` | {_cell(argument.help or '')} |" for argument in arguments]
        lines.append("")
    special, common = [], []
    for option in _options(command):
        name = shared.get((_names(option), option.help or ""))
        default = _default(option)
        if name:
            common.append(f"{name} ({default})" if default else name)
        else:
            special.append(f"| {_names(option)} | {_cell(option.help or '')} | {default} |")
    if special:
        lines += ["| option | | default |", "| --- | --- | --- |", *special, ""]
    if common:
        lines += [f"[Also](#options-of-many-commands): {', '.join(common)}.", ""]
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
