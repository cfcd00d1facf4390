"""Small JSON files of a capture, read with limits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stages.shared.errors import BadData, MissingInput

_MAX_BYTES = 16 << 20


def read_json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        MissingInput: no such file.
        BadData: more than 16 MiB, not JSON, or not an object.
    """
    if not path.is_file():
        raise MissingInput("A file of the capture is not there.", str(path), "Copy the capture again.")
    if path.stat().st_size > _MAX_BYTES:
        raise BadData(
            "The file is too large for a description.", str(path), "Check that this is the right file."
        )
    try:
        value = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise BadData(
            f"The file is not valid JSON: {error}.", str(path), "Mend or replace the file."
        ) from error
    if not isinstance(value, dict):
        raise BadData("The file does not hold a JSON object.", str(path), "Mend or replace the file.")
    return value
