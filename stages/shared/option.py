"""Fields of a configuration that are options of a command, with their help."""

from __future__ import annotations

from dataclasses import field
from typing import Any, Final


def option(default: Any, help: str, **metadata: Any) -> Any:
    """A dataclass field with its help and optional `min`, `max`, `metavar`, `choices`, `panel` and `flag`.

    `panel` is the box of the help page that lists the option. `flag` is the name of the option if it differs
    from the name of the field. `per` is the number of option units per field unit, such as 1000 for an option
    in millimetres and a field in metres. Other metadata belong to the artifact store, such as
    `affects_result`.
    """
    return field(default=default, metadata={"help": help, **metadata})


PICTURE_SCALE: Final[dict[str, Any]] = {
    "help": "Size at which pictures are looked at: 1 is the capture's, 0.25 a quarter. By default 0: a texel "
    "covers two to three pixels, and pictures up to 512 pixels keep their size.",
    "min": 0,
    "max": 1,
    "omit_default": True,
}
