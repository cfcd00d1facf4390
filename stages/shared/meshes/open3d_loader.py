"""The one place that imports open3d.

The Linux wheel of open3d links against libusb (for depth cameras, which nothing here uses) and fails to
import where the system has none. The wheel `libusb-package` brings that library; loading it first under
the same soname satisfies the linker, so no system package is needed.
"""

from __future__ import annotations

import ctypes
import functools
from types import ModuleType


@functools.cache
def load_open3d() -> ModuleType:
    """The module `open3d`, imported on first use."""
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError, TypeError):
        pass  # a system libusb serves as well; where there is neither, open3d's own error names it
    import open3d

    return open3d
