"""The page of commands agrees with the commands."""

from __future__ import annotations

from pathlib import Path

from gw_cli.reference import page

PAGE = Path(__file__).resolve().parents[2] / "docs" / "commands.md"


def test_the_page_is_up_to_date() -> None:
    assert PAGE.read_text() == page(), "out of date: run `make docs`"


def test_every_command_and_option_teaches() -> None:
    """Every section has a sentence, and every option has help."""
    for section in page().split("\n## ")[1:]:
        lines = section.split("\n")
        assert len(lines[4]) > 20, lines[0]
        for row in (line for line in lines if line.startswith("| `")):
            assert len(row.split(" | ")[1].strip()) > 3, f"{lines[0]}: {row}"
