"""Options made from the fields of a configuration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from gw_cli.config_options import config_options
from gw_cli.console import command


def _field(default: Any, **metadata: Any) -> Any:
    return field(default=default, metadata={"help": "Some help.", **metadata})


@dataclass(frozen=True)
class Inner:
    step: int = _field(3, min=1, flag="--inner-step")
    kind: str = _field("a", choices=("a", "b"))
    depth: int = 7


@dataclass(frozen=True)
class Config:
    size: int = _field(10, min=2)
    words: tuple[str, ...] = _field((), flag="--word")
    strict: bool = _field(True)
    pitch: float = _field(0.5, per=1000, min=1)
    secret: float = _field(0.5)
    inner: Inner = field(default_factory=Inner)


PRESETS = {"draft": Config(), "paper": Config(size=90)}


def _run(*arguments: str) -> tuple[int, list[Config], str]:
    app, seen = typer.Typer(), []

    @app.command()
    @command
    @config_options(PRESETS, "draft", omit=("secret",), help={"size": "Pixels."})
    def draw(
        target: str, config: Config = PRESETS["draft"], preset: str = "draft", dry_run: bool = False
    ) -> None:
        seen.append(config)
        assert preset == ("paper" if "paper" in arguments else "draft")
        assert target == "out" and dry_run

    done = CliRunner().invoke(app, ["out", "--dry-run", *arguments])
    return done.exit_code, seen, done.output


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), Config()),
        (("--preset", "paper"), Config(size=90)),
        (("--preset", "paper", "--size", "10"), Config()),
        (("--word", "a, b", "--no-strict"), Config(words=("a", "b"), strict=False)),
        (("--inner-step", "4", "--kind", "b"), Config(inner=Inner(4, "b"))),
        (("--pitch", "9"), Config(pitch=0.009)),
    ],
)
def test_options_change_the_preset(arguments: tuple[str, ...], expected: Config) -> None:
    assert _run(*arguments)[:2] == (0, [expected])


@pytest.mark.parametrize(
    "arguments", [("--size", "1"), ("--secret", "1"), ("--preset", "huge"), ("--kind", "c"), ("--depth", "1")]
)
def test_what_the_fields_do_not_allow_is_refused(arguments: tuple[str, ...]) -> None:
    code, seen, _ = _run(*arguments)
    assert code != 0 and not seen


def test_help_is_that_of_the_fields() -> None:
    text = _run("--help")[2]
    assert "Pixels." in text and "Some help." in text and "--no-strict" in text
