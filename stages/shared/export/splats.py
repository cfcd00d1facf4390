"""One call for all splat formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.errors import BadData, UsageProblem
from stages.shared.export.splat_glb import read_splat_glb, write_splat_glb
from stages.shared.export.spz import read_spz, write_spz
from stages.shared.splat.ply import SplatCloud, read_splat_ply, write_splat_ply

SPLAT_FORMATS = ("ply", "spz", "glb")
UPS = ("auto", "y", "-y")
_READERS: dict[str, Callable[[Path], SplatCloud]] = {
    "ply": read_splat_ply,
    "spz": read_spz,
    "glb": lambda path: read_splat_glb(path)[0],
}


def check_formats(names: tuple[str, ...], option: str) -> None:
    """Raise UsageProblem for a format that does not exist."""
    unknown = [name for name in names if name not in SPLAT_FORMATS]
    if unknown:
        raise UsageProblem(
            f"There is no splat format {unknown[0]!r}.",
            option,
            "Choose of: " + ", ".join(SPLAT_FORMATS) + ".",
        )


def up_of(kind: str, up: str = "auto") -> str:
    """The axis that points up in a file: "y" or "-y".

    Arguments:
        kind: of `SPLAT_FORMATS`. up: of `UPS`; "auto" is what viewers of that format expect.

    Raises UsageProblem for another word, and for a glTF whose y does not point up: the standard asks for it.
    """
    if up not in UPS:
        raise UsageProblem(
            f"There is no axis {up!r} for up.", "option --up", "Choose " + ", ".join(UPS) + "."
        )
    if up == "-y" and kind == "glb":
        raise UsageProblem(
            "In glTF y always points up.", "option --up", "Leave out --up, or export ply, spz."
        )
    return ("-y" if kind == "ply" else "y") if up == "auto" else up


def write_splats(path: Path, cloud: SplatCloud, layers: tuple[str, ...] = ()) -> None:
    """Write Gaussians in the format of the suffix (.ply, .spz, .glb), whole or not at all."""
    kind = path.suffix.removeprefix(".")
    check_formats((kind,), str(path))
    if kind == "ply":
        write_splat_ply(path, cloud)
    elif kind == "spz":
        write_spz(path, cloud)
    else:
        write_splat_glb(path, cloud, layers)


def read_splats(path: Path) -> SplatCloud:
    """Read Gaussians in the format of the suffix. Raises MissingInput, BadData, UsageProblem."""
    kind = path.suffix.removeprefix(".")
    check_formats((kind,), str(path))
    return _READERS[kind](path)


def splat_facts(path: Path) -> dict[str, Any]:
    """What a splat file holds, for people: count, extent (m), opacity, scale, and how many cannot be seen.

    Raises MissingInput, BadData (also for numbers that are not finite).
    """
    cloud = read_splats(path)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        finite = np.isfinite(getattr(cloud, name)).reshape(len(cloud), -1).all(axis=1)
        if not finite.all():
            row = int(np.flatnonzero(~finite)[0])
            raise BadData(f"{name} of Gaussian {row} is not a finite number.", str(path), "Export it again.")
    if not len(cloud):
        return {"gaussians": 0}
    return {
        "gaussians": len(cloud),
        "low": cloud.means.min(axis=0).round(4).tolist(),
        "high": cloud.means.max(axis=0).round(4).tolist(),
        "median_scale": float(np.median(cloud.scales)),
        "largest_scale": float(cloud.scales.max()),
        "invisible": int((cloud.opacities < 1 / 255).sum()),
        "harmonics": 0 if cloud.harmonics is None else cloud.harmonics.shape[1],
    }
