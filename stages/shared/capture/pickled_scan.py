"""Scans of 4D-DRESS: meshes in pickles, with the labels that are kept apart from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.shared.capture.pickles import PickleReader, array_of, dictionary
from stages.shared.errors import BadData
from stages.shared.layers import LABELS
from stages.shared.meshes.mesh import Mesh, check_mesh


def read_scan(path: Path) -> Mesh:
    """The scan of a frame, `Meshes_pkl/mesh-f*.pkl`, with its labels when `Semantic/labels` has them.

    Raises:
        MissingInput, BadData: as `PickleReader.read` and `check_mesh`; labels that do not fit the mesh.
    """
    with PickleReader() as pickles:
        content = dictionary(pickles.read(path), path)
        label_path = path.parent.parent / "Semantic" / "labels" / path.name.replace("mesh-", "label-")
        labels = None
        if label_path.is_file():
            labels = dictionary(pickles.read(label_path), label_path).get("scan_labels")
    vertices, faces = (array_of(content, name, path) for name in ("vertices", "faces"))
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise BadData("vertices or faces do not have three columns.", str(path), "Get the file again.")
    if faces.size and (faces.dtype.kind not in "iu" or int(faces.max()) >= 2**31 or int(faces.min()) < 0):
        raise BadData("faces are not vertex numbers.", str(path), "Get the file again.")
    colors = content.get("colors")
    fitting = isinstance(colors, np.ndarray) and colors.ndim == 2 and len(colors) == len(vertices)
    if labels is not None:
        labels = np.asarray(labels).reshape(-1)
        unknown = sorted(set(np.unique(labels).tolist()) - set(LABELS))
        if len(labels) != len(vertices) or unknown:
            raise BadData(
                f"The labels do not fit: {len(labels)} for {len(vertices)} vertices, unknown {unknown[:5]}.",
                str(label_path),
                "Get the file again.",
            )
    mesh = Mesh(
        vertices,
        faces,
        np.clip(np.asarray(colors)[:, :3], 0, 255).astype(np.uint8) if fitting else None,
        None if labels is None else labels.astype(np.uint8),
    )
    return check_mesh(mesh, str(path))
