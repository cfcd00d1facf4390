"""`python -m tests.pipeline.watched …`: the command line, and a list of everything it reaches for.

The interpreter's audit events name every process that is started, every socket, every file that is opened for
writing. One JSON line a command goes to the file that GW_WATCHED names.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

_PROCESS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty", "os.spawn")
_SOCKET = (
    "socket.connect",
    "socket.bind",
    "socket.getaddrinfo",
    "socket.sendto",
    "urllib.Request",
    "ftplib.connect",
)
_CHANGE = (
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.mkdir",
    "os.link",
    "os.symlink",
    "shutil.rmtree",
    "os.truncate",
)


class Watch:
    """What happened: processes and sockets by name, and paths that were written or changed."""

    def __init__(self) -> None:
        self.processes: list[str] = []
        self.sockets: list[str] = []
        self.written: set[str] = set()

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event in _PROCESS:
            self.processes.append(f"{event} {arguments[1] if len(arguments) > 1 else arguments}"[:300])
        elif event in _SOCKET:
            self.sockets.append(f"{event} {arguments}"[:300])
        elif event in _CHANGE or (event == "open" and _writes(arguments)):
            self._note(arguments[0])

    def _note(self, path: Any) -> None:
        """A path that was written or changed; descriptors were paths before."""
        if isinstance(path, str | bytes | os.PathLike):
            self.written.add(os.path.abspath(os.fsdecode(path)))  # noqa: PTH100


def _writes(arguments: tuple[Any, ...]) -> bool:
    _, mode, flags = arguments
    if isinstance(mode, str):
        return any(letter in mode for letter in "wax+")
    return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


def main() -> None:
    watch = Watch()
    target = os.environ["GW_WATCHED"]
    sys.addaudithook(watch)
    try:
        from gw_cli.app import main as gw

        sys.argv[0] = "gw"
        gw()
    finally:
        line = {
            "command": sys.argv[1:],
            "processes": list(watch.processes),
            "sockets": list(watch.sockets),
            "written": sorted(watch.written),
        }
        with open(target, "a") as file:  # noqa: PTH123
            file.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    main()
