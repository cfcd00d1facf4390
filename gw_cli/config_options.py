"""Options of a command made from the fields of its configuration, so that each is declared once.

A field's metadata gives its `help` and, where they apply, `min`, `max`, `metavar` and `flag` (the option's
name, where it is not the field's).
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import Field, fields, replace
from typing import Annotated, Any, TypeVar, get_type_hints

import typer

from gw_cli.options import Preset, names, preset_config

Command = TypeVar("Command", bound=Callable[..., None])
_NAMES = tuple[str, ...]


def config_options(
    presets: Mapping[str, Any],
    preset: str,
    omit: Collection[str] = (),
    help: Mapping[str, str] | None = None,
) -> Callable[[Command], Command]:
    """Replace the parameter `config` of a command by one option per field, and by --preset.

    The command is called with the preset's configuration, changed by the options. Fields of type
    `tuple[str, ...]` are given as a comma-separated list. A field in which presets differ has no default of
    its own.

    Arguments:
        presets: by name; one dataclass. preset: name of the default one.
        omit: fields without an option. help: texts in place of the fields' own.
    """
    config_type = type(presets[preset])
    types = get_type_hints(config_type)
    shown = [field for field in fields(config_type) if field.name not in omit]
    texts = {field.name: field.metadata["help"] for field in shown} | dict(help or {})

    def option(field: Field[Any]) -> inspect.Parameter:
        varies = len({getattr(config, field.name) for config in presets.values()}) > 1
        limits = {key: field.metadata[key] for key in ("min", "max", "metavar") if key in field.metadata}
        flags = [field.metadata["flag"]] if "flag" in field.metadata else []
        kind = str if types[field.name] == _NAMES else types[field.name]
        default = "" if types[field.name] == _NAMES else None if varies else field.default
        chosen = typer.Option(*flags, help=texts[field.name], **limits)
        annotation = Annotated[kind | None if varies else kind, chosen]  # type: ignore[valid-type]
        return _parameter(field.name, default, annotation)

    def decorate(function: Command) -> Command:
        signature = inspect.signature(function, eval_str=True)
        parameters: list[inspect.Parameter] = []
        for parameter in signature.parameters.values():
            if parameter.name == "config":
                parameters += [*map(option, shown), _parameter("preset", preset, Preset)]
            else:
                parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

        @functools.wraps(function)
        def called(**values: Any) -> None:
            config = preset_config(dict(presets), values.pop("preset"))
            given = {field.name: values.pop(field.name) for field in shown}
            changes = {
                name: names(value) if types[name] == _NAMES else value
                for name, value in given.items()
                if value is not None
            }
            function(**values, config=replace(config, **changes))

        called.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        return called  # type: ignore[return-value]

    return decorate


def _parameter(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
