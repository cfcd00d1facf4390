"""Fields of a configuration that commands offer as options: declared once, with their help."""

from __future__ import annotations

from dataclasses import field
from typing import Any


def option(default: Any, help: str, **metadata: Any) -> Any:
    """A dataclass field with its help and, where they apply, `min`, `max`, `metavar`, `choices`,
    `panel` and `flag`.

    `panel` is the box of the help page that lists the option; `flag` is the option's name where it is not the
    field's. Other metadata are those of the artifact store, such as `affects_result`.
    """
    return field(default=default, metadata={"help": help, **metadata})
