"""Options of a command made from the fields of its configuration, so that each is declared once.

A field declared with `stages.shared.option.option` becomes an option, also in a configuration inside the
configuration. Its metadata give its `help` and, where they apply, `min`, `max`, `metavar`, `choices`, `panel`
(the box of the help page), `flag` (the option's name, where it is not the field's) and `per` (units of the
option in one of the field).
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import typer

from gw_cli.options import Preset, names, one_of, parse_ranks, preset_config

Command = TypeVar("Command", bound=Callable[..., None])
FieldPath = tuple[str, ...]  # names that lead to a value, as ("track", "frame_step")


@dataclass(frozen=True)
class _Option:
    """A field as an option: its path, its type, its metadata."""

    path: FieldPath
    kind: Any
    metadata: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the command's parameter; a flag names the option itself."""
        return "_".join(self.path) if "flag" in self.metadata else self.path[-1]

    def parsed(self, value: Any) -> Any:
        """The field's value of what was typed."""
        if get_origin(self.kind) is not tuple:
            return value / self.metadata["per"] if "per" in self.metadata else value
        return names(value) if get_args(self.kind)[0] is str else parse_ranks(value)


def config_options(
    presets: Mapping[str, Any],
    preset: str | None = None,
    omit: Collection[str] = (),
    help: Mapping[str, str] | None = None,
    completion: Mapping[str, Callable[..., list[str]]] | None = None,
) -> Callable[[Command], Command]:
    """Replace the parameter `config` of a command by one option per declared field, and by --preset.

    The command is called with the preset's configuration, changed by the options, and with the name of the
    preset where it has a parameter `preset`. Tuples are typed as a comma-separated list. A field in which
    presets differ has no default of its own.

    Arguments:
        presets: configurations of one dataclass, by name.
        preset: name of the default one; None where there is only one, and then no --preset.
        omit: fields without an option. help: texts in place of the fields' own. completion: what
            the shell offers at the Tab key, where that is not the field's `choices`.
    """
    (first, *_) = presets
    options = [option for option in _declared(type(presets[first])) if option.name not in omit]
    texts = {option.name: option.metadata["help"] for option in options} | dict(help or {})

    def parameter_of(option: _Option) -> inspect.Parameter:
        values = [functools.reduce(getattr, option.path, config) for config in presets.values()]
        default = values[0] if all(value == values[0] for value in values) else None
        kind: Any = option.kind
        if get_origin(kind) is tuple:
            kind, default = str, None if default is None else ",".join(str(part) for part in default)
        if default is not None and "per" in option.metadata:
            default = default * option.metadata["per"]
        if default is None:
            kind = kind | None
        limits = {key: option.metadata[key] for key in ("min", "max", "metavar") if key in option.metadata}
        limits["rich_help_panel"] = option.metadata.get("panel")
        flags = [option.metadata["flag"]] if "flag" in option.metadata else []
        offered: Any = {"autocompletion": (completion or {}).get(option.name), **_choices(option)}
        made: Any = Annotated[kind, typer.Option(*flags, help=texts[option.name], **{**limits, **offered})]
        return _parameter(option.name, default, made)

    def decorate(function: Command) -> Command:
        signature = inspect.signature(function, eval_str=True)
        parameters: list[inspect.Parameter] = []
        for parameter in signature.parameters.values():
            if parameter.name == "config":
                parameters += map(parameter_of, options)
                parameters += [] if preset is None else [_parameter("preset", preset, Preset)]
            elif preset is None or parameter.name != "preset":
                parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

        @functools.wraps(function)
        def called(**values: Any) -> None:
            name = first
            if preset is not None:  # a command may take the name as well
                name = values["preset"] if "preset" in signature.parameters else values.pop("preset")
            config = preset_config(dict(presets), name)
            for option in options:
                value = values.pop(option.name)
                if value is not None:
                    config = _with(config, option.path, option.parsed(value))
            function(**values, config=config)

        called.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        return called  # type: ignore[return-value]

    return decorate


def _choices(option: _Option) -> dict[str, Any]:
    """Completion and check of an option that takes one of a few words."""
    words: tuple[str, ...] = option.metadata.get("choices", ())
    if not words:
        return {}
    shown = option.metadata.get("flag", "--" + option.path[-1].replace("_", "-"))

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    def check(value: str | None) -> str | None:
        return value if value is None else one_of(shown, value, words)

    return {"autocompletion": complete, "callback": check}


def _declared(config_type: type, above: FieldPath = ()) -> Iterator[_Option]:
    """The declared fields of a configuration and of those inside it, in order."""
    kinds = get_type_hints(config_type)
    for field in fields(config_type):
        path, kind = (*above, field.name), kinds[field.name]
        if isinstance(kind, type) and is_dataclass(kind):
            yield from _declared(kind, path)
        elif "help" in field.metadata:
            yield _Option(path, kind, field.metadata)


def _with(config: Any, path: FieldPath, value: Any) -> Any:
    """The configuration with another value at a path."""
    if len(path) > 1:
        value = _with(getattr(config, path[0]), path[1:], value)
    return replace(config, **{path[0]: value})


def _parameter(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
