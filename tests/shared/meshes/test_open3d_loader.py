"""Loading open3d: what it needs of the system is known, and a lack of it is said with its cure."""

from __future__ import annotations

import struct
import sys
from collections.abc import Sequence
from importlib import metadata
from importlib.abc import MetaPathFinder
from pathlib import Path
from types import ModuleType

import pytest

from stages.shared.errors import MissingInput
from stages.shared.meshes.raycast import SYSTEM_LIBRARIES, load_open3d

# In every Linux that runs Python, or brought by a wheel.
ALWAYS = ("libc.", "libm.", "libstdc++.", "libgcc_s.", "libpthread.", "libdl.", "ld-linux", "libusb-1.0.")
_LOAD, _DYNAMIC, _NEEDED, _TEXTS = 1, 2, 1, 5


def needed(path: Path) -> list[str]:
    """Names of the shared libraries that a 64-bit ELF file asks the linker for (DT_NEEDED)."""
    with path.open("rb") as file:
        head = file.read(64)
        assert head[:6] == b"\x7fELF\x02\x01"
        (start,), (size, count) = struct.unpack_from("<Q", head, 32), struct.unpack_from("<HH", head, 54)
        file.seek(start)
        table = file.read(size * count)
        rows = [struct.unpack_from("<IIQQQQ", table, size * row) for row in range(count)]
        (dynamic,) = [(offset, length) for kind, _, offset, _, _, length in rows if kind == _DYNAMIC]
        file.seek(dynamic[0])
        entries = list(struct.iter_unpack("<QQ", file.read(dynamic[1])))
        address = next(value for tag, value in entries if tag == _TEXTS)
        inside = [
            offset + address - place
            for kind, _, offset, place, _, length in rows
            if kind == _LOAD and place <= address < place + length
        ]
        names = []
        for tag, value in entries:
            if tag == _NEEDED:
                file.seek(inside[0] + value)
                names.append(file.read(256).split(b"\0")[0].decode())
        return names


@pytest.mark.skipif(sys.platform != "linux", reason="the wheel of another system")
def test_what_the_wheel_links_against_is_known() -> None:
    files = [Path(str(file.locate())) for file in metadata.files("open3d") or [] if ".so" in file.name]
    brought = {file.name for file in files}
    (library,) = [file for file in files if file.name.startswith("libOpen3D.so")]
    asked = [name for name in needed(library) if name not in brought and not name.startswith(ALWAYS)]
    assert sorted(asked) == sorted(SYSTEM_LIBRARIES)


def test_a_library_that_is_not_there_is_said_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    class Lacking(MetaPathFinder):
        def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
            if name == "open3d":
                raise ImportError("libEGL.so.1: cannot open shared object file: No such file or directory")

    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Lacking(), *sys.meta_path])
    with pytest.raises(MissingInput, match=r"libEGL\.so\.1.*apt install libegl1"):
        load_open3d.__wrapped__()
