"""Help pages: three groups of commands, boxes of options, nothing cut at 80 columns, printed once."""

from __future__ import annotations

from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner

from gw_cli.app import app


def _help(*words: str) -> str:
    done = CliRunner().invoke(app, [*words], prog_name="gw", env={"COLUMNS": "80"})
    return done.output


def _commands(group: Any, before: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    rows = []
    for name, command in group.commands.items():
        rows += _commands(command, (*before, name)) if hasattr(command, "commands") else []
        rows.append(((*before, name), command))
    return rows


COMMANDS = _commands(typer.main.get_command(app))


@pytest.mark.parametrize(("words", "command"), COMMANDS, ids=[" ".join(words) for words, _ in COMMANDS])
def test_every_option_name_is_whole_at_80_columns(words: tuple[str, ...], command: Any) -> None:
    page = _help(*words, "--help")
    assert all(len(line) <= 80 for line in page.splitlines()) and "…│" not in page
    shown = page.replace("│", " ").split()
    for parameter in command.params:
        if parameter.param_type_name == "option" and not parameter.hidden:
            for name in (*parameter.opts, *parameter.secondary_opts):
                assert name in shown or f"{name}," in shown, name


def test_commands_stand_in_three_groups() -> None:
    page = _help("--help")
    assert page.index("─ Make") < page.index("─ Wear") < page.index("─ Measure")
    assert page.index("│ tryon") > page.index("─ Wear") > page.index("│ train")


def test_usage_brackets_only_what_may_be_left_out() -> None:
    assert "gw label [OPTIONS] SUBJECT\n" in _help("label", "--help").replace("python -m gw_cli", "gw")
    assert all("{" not in _help(*words, "--help").splitlines()[0] for words, _ in COMMANDS)


@pytest.mark.parametrize("words", [(), ("wardrobe",), ("bench",)])
def test_a_group_without_a_command_prints_its_help_once(words: tuple[str, ...]) -> None:
    page = _help(*words)
    assert page.count("Usage:") == 1 and "error:" not in page


def test_options_stand_in_boxes_and_the_general_ones_come_last() -> None:
    page = _help("render", "--help")
    assert (
        page.index("─ Arguments") < page.index("─ Camera") < page.index("─ General") < page.index("--dry-run")
    )
