"""One call for all splat formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from stages.shared.errors import UsageProblem
from stages.shared.export.splat_glb import read_splat_glb, write_splat_glb
from stages.shared.export.spz import read_spz, write_spz
from stages.shared.splat.ply import SplatCloud, read_splat_ply, write_splat_ply

SPLAT_FORMATS = ("ply", "spz", "glb")
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
