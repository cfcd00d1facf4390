"""The one place that imports open3d.

The Linux wheel of open3d links against libusb (for depth cameras, which nothing here uses) and fails to
import where the system has none. The wheel `libusb-package` brings that library; loading it first under
the same soname satisfies the linker. What it needs for windows, which nothing here opens, no wheel brings:
every desktop has it, a small server or container image may not.
"""

from __future__ import annotations

import ctypes
import functools
from types import ModuleType

from stages.shared.errors import MissingInput

# Libraries of the system that open3d's wheel links against, and Debian's packages of them.
SYSTEM_LIBRARIES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
}


@functools.cache
def load_open3d() -> ModuleType:
    """The module `open3d`, imported on first use.

    Raises:
        MissingInput: a library of the system that it links against is not there; names the packages.
    """
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError, TypeError):
        pass  # a system libusb serves as well; where there is neither, open3d's own error names it
    try:
        import open3d
    except ModuleNotFoundError:
        raise
    except ImportError as error:
        raise MissingInput(
            f"open3d cannot be loaded: {error}.",
            "the wheel open3d",
            "Install the libraries that it links against: apt install "
            + " ".join(SYSTEM_LIBRARIES.values())
            + " (Debian, Ubuntu).",
        ) from error
    return open3d
