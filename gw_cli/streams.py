"""Standard output and error, which may be closed, broken or ASCII only; and text that is safe to show.

Text from files (names, notes, messages of other libraries) may hold control characters, which a terminal
would obey. `shown` escapes them. `write` never fails, also when the stream is closed.
"""

from __future__ import annotations

import codecs
import contextlib
import os
import signal
import sys
import unicodedata
from typing import Any, TextIO

_OUTPUT_LOST = 74  # exit code where standard output was closed before everything was written
_ASCII = {
    "…": "...",
    "–": "-",
    "−": "-",
    "—": "-",
    "×": "x",
    "°": " deg",
    "·": "|",
    "’": "'",
    "“": '"',
    "”": '"',
}
_HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")  # controls, formats (bidirectional marks), surrogates, separators
_broken: set[str] = set()  # streams whose reader has gone


def shown(text: str) -> str:
    """The text in one line, with every control, format and separator character as an escape."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escaped(letter) if unicodedata.category(letter) in _HIDDEN else letter for letter in text)


def _escaped(letter: str) -> str:
    code = ord(letter)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def encodable(text: str) -> str:
    """The text with what standard output's encoding does not have replaced."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    return text.encode(encoding, "gw-ascii").decode(encoding)


def write(name: str, text: str) -> None:
    """Write to the stream `stdout` or `stderr` and flush it; a reader that has gone is not an error."""
    stream: TextIO | None = getattr(sys, name)
    if stream is None or name in _broken:
        return
    try:
        stream.write(text)
        stream.flush()
    except (OSError, ValueError):  # a broken pipe, a full device, a closed stream
        _broken.add(name)
        _silence(stream)


def is_terminal(name: str) -> bool:
    """Whether a person reads the stream `stdout` or `stderr`."""
    stream: TextIO | None = getattr(sys, name)
    try:
        return stream is not None and stream.isatty()
    except ValueError:  # closed
        return False


def exit_code(status: int) -> int:
    """The exit code of a command whose own is `status`: success needs that its output was taken."""
    return _OUTPUT_LOST if status == 0 and "stdout" in _broken else status


def prepare() -> None:
    """Make the standard streams usable, and treat SIGTERM like an interrupt. Called once, first of all."""
    for descriptor in range(3):  # a file that is opened later must not become standard output by accident
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):
        stream: Any = getattr(sys, name)
        if stream is None:
            # The parent process closed it. A command without standard output fails at its end.
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="gw-ascii")
    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGTERM, _interrupt)


def ignore_signals() -> None:
    """Ignore SIGTERM and Ctrl-C while the interpreter ends: the command is done, its exit code stays."""
    with contextlib.suppress(ValueError):  # not in the main thread
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)


def _interrupt(number: int, frame: Any) -> None:
    signal.signal(number, signal.SIG_DFL)  # a second one ends the process at once
    raise KeyboardInterrupt


def _replaced(error: UnicodeError) -> tuple[str, int]:
    """Characters that the stream's encoding does not have: plain ones where there are some, else escapes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    return "".join(_ASCII.get(letter, _escaped(letter)) for letter in letters), error.end


def _silence(stream: TextIO) -> None:
    """Let what is still in the stream's buffer go nowhere, so that the end of the process is quiet too."""
    with contextlib.suppress(OSError, ValueError):
        target = os.open(os.devnull, os.O_WRONLY)
        os.dup2(target, stream.fileno())
        os.close(target)


codecs.register_error("gw-ascii", _replaced)
