"""Fields of a configuration that commands offer as options: declared once, with their help."""

from __future__ import annotations

from dataclasses import field
from typing import Any, Final


def option(default: Any, help: str, **metadata: Any) -> Any:
    """A dataclass field with its help and, where they apply, `min`, `max`, `metavar`, `choices`,
    `panel` and `flag`.

    `panel` is the box of the help page that lists the option; `flag` is the option's name where it is not the
    field's; `per` says how many units of the option are one of the field, as 1000 for millimetres and metres.
    Other metadata are those of the artifact store, such as `affects_result`.
    """
    return field(default=default, metadata={"help": help, **metadata})


PICTURE_SCALE: Final[dict[str, Any]] = {
    "help": "Size at which pictures are looked at: 1 is the capture's, 0.25 a quarter. By default 0: a texel "
    "covers two to three pixels, and pictures up to 512 pixels keep their size.",
    "min": 0,
    "max": 1,
    "said_if_set": True,
}
