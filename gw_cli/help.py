"""Help pages that fit the terminal: one box per subject, and no option name is ever cut."""

from __future__ import annotations

import inspect
import re
import shutil
import sys
from collections.abc import Iterable
from typing import Any

import typer
from rich.console import Console as RichConsole
from rich.padding import Padding
from rich.panel import Panel
from rich.table import Table
from rich.text import Text
from typer.core import TyperCommand, TyperGroup

from gw_cli import streams

GENERAL = "General"  # the box of the options that most commands have; the last one
_WIDEST = 100  # columns; longer lines are hard to read
_WIDEST_NAME = 30  # columns of the names, where no single name is longer
_KINDS = {"int": "N", "float": "X", "Path": "PATH", "str": "TEXT"}


class CommandApp(typer.Typer):
    """Typer with these help pages. `panel` is the box in which the next commands are listed."""

    panel: str | None = None

    def command(self, name: str | None = None, **settings: Any) -> Any:
        settings.setdefault("rich_help_panel", self.panel)
        return super().command(name, cls=_Command, **settings)

    def add_group(self, name: str, help: str) -> CommandApp:
        """A command with subcommands; without one it prints its help."""
        group = CommandApp(help=help, no_args_is_help=True)
        self.add_typer(group, name=name, cls=HelpGroup, rich_help_panel=self.panel)
        return group


class _Command(TyperCommand):
    def format_help(self, ctx: Any, formatter: Any) -> None:
        formatter.write(_help_page(self, ctx))


class HelpGroup(TyperGroup):
    """A group of commands with this module's help pages."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        formatter.write(_help_page(self, ctx))


def default_text(option: Any) -> str:
    """The default of an option as it would be typed; "" where there is none."""
    value = option.default() if callable(option.default) else option.default
    if value is None or value is False or value == "" or "Sentinel" in type(value).__name__:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(option.opts[0] if value is True else value)


def usage(ctx: Any) -> str:
    """The usage line in one line: an argument that is required has no brackets, an optional one has."""
    line = re.sub(r"\{([^{}]*)\}", r"\1", " ".join(ctx.get_usage().split()))
    return line.replace("…...", "…").replace("…]...", "…]")


def _help_page(command: Any, ctx: Any) -> str:
    """Usage, description, and a box of arguments, options or commands per subject."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    console = RichConsole(file=sys.stdout, width=width, highlight=False, markup=False, emoji=False)
    boxes: dict[str, list[tuple[Text, Text]]] = {}
    for parameter in command.get_params(ctx):
        if not getattr(parameter, "hidden", False):
            argument = parameter.param_type_name == "argument"
            title = getattr(parameter, "rich_help_panel", None) or ("Arguments" if argument else "Options")
            title = GENERAL if parameter.name == "help" else title
            boxes.setdefault(title, []).append((_names(parameter), _description(parameter, argument)))
    for name, subcommand in getattr(command, "commands", {}).items():
        if not subcommand.hidden:
            title = getattr(subcommand, "rich_help_panel", None) or "Commands"
            boxes.setdefault(title, []).append((Text(name, "bold cyan"), Text(_first_line(subcommand))))
    with console.capture() as captured:
        console.print(Text(usage(ctx), "bold"))
        _print_description(console, inspect.cleandoc(command.help or ""))
        for title, rows in sorted(boxes.items(), key=lambda box: box[0] == GENERAL):
            console.print(_box(title, rows))
    return streams.encodable("\n".join(line.rstrip() for line in captured.get().splitlines()) + "\n")


def _box(title: str, rows: Iterable[tuple[Text, Text]]) -> Panel:
    table = Table.grid(padding=(0, 2, 0, 0), expand=True)
    table.add_column(no_wrap=True)
    table.add_column(ratio=1)
    for names, text in rows:
        table.add_row(names, text)
    return Panel(table, title=title, title_align="left", border_style="dim")


def _names(parameter: Any) -> Text:
    """Names and placeholder of a parameter, on several lines where one would be too wide."""
    if parameter.param_type_name == "argument":
        return Text(str(parameter.metavar or parameter.name.upper()), "bold cyan")
    kind = parameter.metavar
    if kind is None and not parameter.is_flag:
        annotation = str(getattr(getattr(parameter, "type_descriptor", None), "annotation", ""))
        kind = next((short for name, short in _KINDS.items() if name in annotation), "VALUE")
    short_first = sorted(parameter.opts, key=len) + list(parameter.secondary_opts)
    parts = [", ".join(short_first)] if len(", ".join(short_first)) <= _WIDEST_NAME else short_first
    text = Text("\n".join(parts), "bold cyan")
    if kind:
        fits = len(parts[-1]) + 1 + len(kind) <= _WIDEST_NAME
        text.append((" " if fits else "\n  ") + kind, "not bold yellow")
    return text


def _description(parameter: Any, argument: bool) -> Text:
    """The help of a parameter, its range, and its default."""
    text = Text(" ".join((parameter.help or "").split()))
    low, high = getattr(parameter, "min", None), getattr(parameter, "max", None)
    facts = []
    if low is not None and not getattr(parameter, "count", False):
        facts.append(f"{low:g} or more" if high is None else f"{low:g} to {high:g}")
    if parameter.required and not argument:
        facts.append("required")
    elif default := default_text(parameter):
        facts.append(f"default: {default}")
    return text.append(f" [{'; '.join(facts)}]" if facts else "", "dim")


def _first_line(command: Any) -> str:
    return inspect.cleandoc(command.help or "").split("\n\n")[0].replace("\n", " ")


def _print_description(console: RichConsole, text: str) -> None:
    """Paragraphs of a docstring; example commands stay together, indented, without blank lines."""
    examples = False
    for paragraph in text.split("\n\n"):
        words = " ".join(paragraph.split())
        if not (examples and words.startswith("gw ")):
            console.print()
        examples = words.startswith("gw ")
        console.print(Padding(Text(words, "cyan"), (0, 0, 0, 4)) if examples else Text(words))
    console.print()
