"""A headless Chromium for tests, controlled over its debugging pipe: no driver, no port, no package.

Protocol: Chrome DevTools Protocol; with `--remote-debugging-pipe`, JSON messages that end in a zero byte
go through file descriptors 3 and 4.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

_SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def chromium() -> str:
    """The program, or the test is skipped with the reason."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    pytest.skip("no Chromium on this machine: apt-get install chromium")


class Page:
    """One tab; everything that it complains about is collected in `complaints`, every address it asks for in
    `requests`."""

    def __init__(
        self, process: subprocess.Popen[bytes], write: int, read: int, size: tuple[int, int], phone: bool
    ) -> None:
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self._process, self._write, self._read = process, write, read
        self._buffer, self._count, self._session = b"", 0, ""
        self._loaded = False
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        attached = self._call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")
        width, height = size
        self._call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )
        self._call("Emulation.setTouchEmulationEnabled", enabled=phone)

    def open(self, address: str, seconds: float = 120) -> None:
        """Open an address and wait until the page is loaded."""
        self._loaded = False
        self._call("Page.navigate", url=address)
        deadline = time.monotonic() + seconds
        while not self._loaded:
            self._receive(deadline)

    def run(self, code: str, seconds: float = 120) -> Any:
        """The value of a JavaScript expression; promises are waited for."""
        answer = self._call(
            "Runtime.evaluate", seconds, expression=code, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in answer:
            raise RuntimeError(json.dumps(answer["exceptionDetails"])[:2000])
        return answer["result"].get("value")

    def wait_for(self, code: str, seconds: float = 120) -> None:
        """Until an expression is true."""
        deadline = time.monotonic() + seconds
        while not self.run(code):
            assert time.monotonic() < deadline, f"{code} never came true; {self.complaints}"
            time.sleep(0.05)

    def press(self, key: str, shift: bool = False) -> None:
        """Press and release a key, as `KeyboardEvent.key` names it."""
        for kind in ("keyDown", "keyUp"):
            self._call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=8 if shift else 0)

    def screenshot(self) -> np.ndarray:
        """(H, W, 3) u8 of what is on the screen."""
        data = base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None, "the browser sent no PNG"
        return picture[..., ::-1]

    def _call(self, method: str, seconds: float = 120, **parameters: Any) -> dict[str, Any]:
        self._count += 1
        number = self._count
        message: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + seconds
        while True:
            answer = self._receive(deadline)
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def _receive(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            left = deadline - time.monotonic()
            assert left > 0 and self._process.poll() is None, "the browser does not answer"
            if select.select([self._read], [], [], min(left, 1))[0]:
                self._buffer += os.read(self._read, 1 << 20)
        text, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        self._notice(message)
        return message

    def _notice(self, message: dict[str, Any]) -> None:
        method, facts = message.get("method"), message.get("params", {})
        if method == "Page.loadEventFired":
            self._loaded = True
        elif method == "Network.requestWillBeSent":
            self.requests.append(facts["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(facts["exceptionDetails"])[:500])
        elif method == "Log.entryAdded" and facts["entry"]["level"] == "error":
            self.complaints.append(facts["entry"]["text"])
        elif method == "Runtime.consoleAPICalled" and facts["type"] in ("error", "assert"):
            self.complaints.append(json.dumps(facts["args"])[:500])


@contextlib.contextmanager
def browser_page(width: int, height: int, phone: bool = False) -> Iterator[Page]:
    """A new browser with one empty tab, drawing without a graphics card; a phone has touch and no mouse."""
    program = chromium()
    commands_out, commands_in = os.pipe()
    answers_out, answers_in = os.pipe()

    def connect() -> None:
        """In the child: descriptors 3 and 4 are the pipe's ends."""
        first, second = os.dup(commands_out), os.dup(answers_in)
        os.dup2(first, 3)
        os.dup2(second, 4)

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [program, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars"]
        words += ["--no-first-run", "--disable-background-networking", "--disable-extensions", "--mute-audio"]
        words += [*_SOFTWARE_GL, "--remote-debugging-pipe", f"--user-data-dir={profile}", "about:blank"]
        process = subprocess.Popen(
            words, preexec_fn=connect, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(commands_out)
        os.close(answers_in)
        try:
            yield Page(process, commands_in, answers_out, (width, height), phone)
        finally:
            process.kill()
            process.wait(30)
            os.close(commands_in)
            os.close(answers_out)
