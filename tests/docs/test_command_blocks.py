"""Every command in README and docs exists, with every option that it has there."""

from __future__ import annotations

import importlib
import re
import shlex
from typing import Any

import pytest
import typer.main
from typer._click.exceptions import BadOptionUsage, MissingParameter

from gw_cli.app import app
from tests.docs.pages import PAGES, REPOSITORY, blocks, inline

# Placeholders of the documentation, and values that replace them.
STANDS_FOR = {
    "N": "1",
    "I/N": "1/2",
    "A,B": "1,2",
    "PX": "64",
    "MINUTES": "1",
    "DB": "0.3",
    "FPS": "25",
    "P": "draft",
}


BENCHMARK = "tests.benchmarks.NAME"  # placeholder for any benchmark
LINES = [
    pytest.param(line, whole, id=f"{page.name}: {line[:60]}")
    for page in PAGES
    for lines, whole in (
        ([line for block in blocks(page) if block.kind == "shell" for line in block.commands], True),
        (inline(page), False),
    )
    for line in dict.fromkeys(lines)
]


def understood(line: str, whole: bool = True) -> None:
    """Raise unless the command exists and every option accepts its value."""
    for part in re.split(r"\s*(?:&&|;|\|)\s*", line):
        words = [word for word in shlex.split(part) if not re.fullmatch(r"[A-Z_]+=.*", word)]
        program = next((word for word in ("gw", "gw_cli") if word in words[:6]), None)
        if program:
            words = words[words.index(program) + 1 :]
            understood_by([word for word in words if word not in ("…", "...")], whole, app)
        elif words[:2] == ["python", "-m"] and words[2] != BENCHMARK:
            module = (
                words[2]
                if (REPOSITORY / f"{words[2].replace('.', '/')}.py").is_file()
                else f"{words[2]}.__main__"
            )
            understood_by(words[3:], whole, importlib.import_module(module).app)
        elif words[:1] == ["make"]:
            targets = re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
            assert all(word in targets for word in words[1:] if re.fullmatch(r"[a-z-]+", word)), line


def understood_by(words: list[str], whole: bool, program: typer.Typer) -> None:
    command: Any = typer.main.get_command(program)
    while hasattr(command, "commands"):
        if not words or words[0].startswith("-"):
            return
        assert words[0] in command.commands, f"there is no command {words[0]}"
        command, words = command.commands[words[0]], words[1:]
    arguments = [STANDS_FOR.get(word, word) for word in words]
    if "-h" not in arguments and "--help" not in arguments:
        try:
            command.make_context(command.name, arguments)
        except (MissingParameter, BadOptionUsage):  # a sentence may leave out arguments
            assert not whole


@pytest.mark.parametrize(("line", "whole"), LINES)
def test_it_is_understood(line: str, whole: bool) -> None:
    understood(line, whole)


@pytest.mark.parametrize(
    "line",
    [
        "gw trian SUBJECT",
        "gw train SUBJECT --presets draft",
        "gw synth",
        "make coffee",
        "gw status a --preset",
        "torchrun --nproc-per-node 2 -m gw_cli trian SUBJECT",
    ],
)
def test_a_line_that_is_wrong_is_seen(line: str) -> None:
    with pytest.raises(Exception):  # noqa: B017 - whatever the parser raises
        understood(line)
