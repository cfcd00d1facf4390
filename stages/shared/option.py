"""Fields of a configuration that commands offer as options: declared once, with their help."""

from __future__ import annotations

from dataclasses import field
from typing import Any


def option(default: Any, help: str, **metadata: Any) -> Any:
    """A dataclass field with its help and, where they apply, `min`, `max`, `metavar`, `choices` and `flag`.

    Other metadata are those of the artifact store, such as `affects_result`.
    """
    return field(default=default, metadata={"help": help, **metadata})
