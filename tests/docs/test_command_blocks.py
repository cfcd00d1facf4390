"""Every command that README and docs show is understood today; the README's chain is run whole."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer._click.exceptions import MissingParameter

from gw_cli.app import app

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
GENERATED = {"commands.md"}
# What the documentation writes where a user puts numbers or paths.
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


def blocks(page: Path) -> list[list[str]]:
    """Lines of every fenced block of shell commands, comments taken off, continued lines joined."""
    found = []
    for block in re.findall(
        r"^```(?:sh|bash|console|shell)\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL
    ):
        text = block.replace("\\\n", " ")
        lines = [re.sub(r"\s+#.*$", "", line).removeprefix("$ ").strip() for line in text.split("\n")]
        found.append([line for line in lines if line and not line.startswith("#")])
    return found


def inline(page: Path) -> list[str]:
    """Commands with options inside sentences: `gw train SUBJECT --minutes 10`."""
    return [text for text in re.findall(r"`(gw [^`]+)`", page.read_text()) if " -" in text]


LINES = [
    pytest.param(line, whole, id=f"{page.name}: {line[:60]}")
    for page in PAGES
    if page.name not in GENERATED
    for lines, whole in (([line for block in blocks(page) for line in block], True), (inline(page), False))
    for line in dict.fromkeys(lines)
]


def understood(line: str, whole: bool = True) -> None:
    """Raise, or return: the command exists, and every option takes what it is given."""
    for part in re.split(r"\s*(?:&&|;|\|)\s*", line):
        words = [word for word in shlex.split(part) if not re.fullmatch(r"[A-Z_]+=.*", word)]
        if "gw" in words[:4] or words[:3] == ["torchrun", "-m", "gw_cli"]:
            words = words[words.index("gw") + 1 :] if "gw" in words else words[3:]
            understood_by_gw([word for word in words if word not in ("…", "...")], whole)
        elif words[:1] == ["make"]:
            targets = re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
            assert all(word in targets for word in words[1:] if re.fullmatch(r"[a-z-]+", word)), line


def understood_by_gw(words: list[str], whole: bool) -> None:
    command: Any = typer.main.get_command(app)
    while hasattr(command, "commands"):
        if not words or words[0].startswith("-"):
            return
        assert words[0] in command.commands, f"there is no command {words[0]}"
        command, words = command.commands[words[0]], words[1:]
    arguments = [STANDS_FOR.get(word, word) for word in words]
    if "-h" not in arguments and "--help" not in arguments:
        try:
            command.make_context(command.name, arguments)
        except MissingParameter:  # a sentence may leave out what it does not speak of
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
    ],
)
def test_a_line_that_is_wrong_is_seen(line: str) -> None:
    with pytest.raises(Exception):  # noqa: B017 - whatever the parser raises
        understood(line)


def test_there_are_blocks_to_look_at() -> None:
    assert sum(len(block) for block in blocks(REPOSITORY / "README.md")) >= 10


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_chain_of_the_readme(tmp_path: Path) -> None:
    """The block of one's own capture, on a tiny synthetic one."""
    (chain,) = [
        block for block in blocks(REPOSITORY / "README.md") if any("register-template" in x for x in block)
    ]

    def gw(words: list[str]) -> None:
        done = subprocess.run(
            [sys.executable, "-m", "gw_cli", *words],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{words}: {done.stderr}"

    gw(["synth", "people", "--preset", "tiny"])
    places = {
        "CAPTURE": "people/subject_1",
        "SUBJECT": "anna",
        "motion.npz": "people/motions/held_out.npz",
        "draft": "tiny",
    }
    root: Any = typer.main.get_command(app)
    for number, line in enumerate(chain):
        words = [places.get(word, word) for word in shlex.split(line)[1:]]
        words = [f"out{number}" if word == "OUT" else word for word in words]
        takes = {name for parameter in root.commands[words[0]].params for name in parameter.opts}
        if "--preset" in takes and "--preset" not in words:
            words += ["--preset", "tiny"]
        gw(words)
