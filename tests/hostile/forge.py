"""Bundles whose digests are right though their content is not what a bundle may hold."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from stages.shared.artifacts.arrays import encode_arrays
from stages.shared.artifacts.bundle import SCHEMA, Bundle
from stages.shared.artifacts.canonical import canonical_json, digest

_INFINITE = 1.25e300  # stands for a number that the canonical text cannot hold


def forged(bundle: Bundle, change: dict[str, Any]) -> bytes:
    """The file of a bundle with some fields of its manifest replaced; 1e400 is written as such."""
    return forged_parts(bundle.arrays, {**bundle.manifest, **change})


def forged_parts(arrays: dict[str, np.ndarray], manifest: dict[str, Any]) -> bytes:
    """The file of arrays and manifest, with right digests and without any check."""
    tensors = {}
    for name, array in arrays.items():
        array = np.ascontiguousarray(array)
        mark = f"{array.dtype.newbyteorder('<').str} {list(array.shape)} ".encode()
        tensors[name] = {"sha256": digest(mark + array.tobytes())}
    content = {"schema": SCHEMA, **manifest, "tensors": tensors}
    text = canonical_json(json.loads(json.dumps(content).replace("Infinity", str(_INFINITE))))
    text = text.replace(json.dumps(_INFINITE).encode(), b"1e400")
    return b"".join(encode_arrays(arrays, "forged", {"gwg": text.decode(), "gwg_sha256": digest(text)}))
