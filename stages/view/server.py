"""The viewer's web server: a page, and answers to what it asks; nothing else of the machine can be reached.

    GET  /                     the page
    GET  /show                 pieces, motions, shape, camera to begin with (JSON)
    GET  /gaussians?wear=a,b&motion=0&row=3&betas=…    packed Gaussians
    POST /picture              {wear, motion, row, betas, camera, hidden, background} -> PNG

Only names that the shelf knows are understood, never paths. Requests whose `Host` is another one than the
address that was given out are refused (a foreign page cannot reach a local server by renaming itself), and no
other origin is allowed in. With a token, everything needs it: `?token=` for the page, a header after that.
"""

from __future__ import annotations

import hmac
import json
import secrets
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

from stages.shared.artifacts.canonical import strict_json
from stages.shared.errors import GwError, StorageFailure, UsageProblem
from stages.shared.web.start import viewer_script
from stages.view.show import Show, Wish, camera_of

_LONGEST_REQUEST = 64 << 10
_TIMEOUT = 30  # s, for a client that says nothing
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Viewer(ThreadingHTTPServer):
    """Serves a show.

    Attributes:
        url: what to open, with the token if there is one.
    """

    daemon_threads = True

    def __init__(self, host: str, port: int, show: Show, betas: str = "") -> None:
        self.show, self.betas = show, betas
        self.token = "" if _is_this_machine(host) else secrets.token_urlsafe(18)
        try:
            super().__init__((host, port), _Answers)
        except OSError as error:
            raise StorageFailure(
                f"Cannot listen on {host}:{port}: {error.strerror or error}.",
                f"{host}:{port}",
                "Choose another --port (0 takes a free one), or another --host.",
            ) from error
        port = self.server_address[1]
        names = {host, "127.0.0.1", "localhost"} if _is_this_machine(host) else {""}
        self.hosts = {f"{name}:{port}" for name in names} if not self.token else set()
        shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        self.url = f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")

    def page(self) -> bytes:
        """The page with its scripts inside."""
        folder = resources.files("stages.view")
        page = folder.joinpath("view.html").read_text("utf-8")
        page = page.replace("@VIEWER@", viewer_script())
        return page.replace("@VIEW@", folder.joinpath("view.js").read_text("utf-8")).encode()


class _Answers(BaseHTTPRequestHandler):
    """One connection."""

    server: Viewer
    timeout = _TIMEOUT
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "gw", ""

    def do_GET(self) -> None:
        address = urlsplit(self.path)
        query = {name: values[-1] for name, values in parse_qs(address.query).items()}
        routes: dict[str, Callable[[], tuple[str, bytes]]] = {
            "/": lambda: ("text/html; charset=utf-8", self.server.page()),
            "/show": lambda: _json(self.server.show.described(self.server.betas)),
            "/gaussians": lambda: ("application/octet-stream", self.server.show.gaussians(_wish(query))),
        }
        self._answer(routes.get(address.path), query.get("token", ""))

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > _LONGEST_REQUEST:
            self.close_connection = True
            self._send(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, *_trouble("The request is too long.", ""))
            return
        body = self.rfile.read(int(length))
        routes = {"/picture": lambda: ("image/png", self._picture(body))}
        self._answer(routes.get(urlsplit(self.path).path), "")

    def _picture(self, body: bytes) -> bytes:
        try:
            asked = strict_json(body)
        except (ValueError, RecursionError) as error:
            raise UsageProblem("The request is not JSON.", "request", "Reload the page.") from error
        if not isinstance(asked, dict):
            raise UsageProblem("The request is not an object.", "request", "Reload the page.")
        hidden = (
            [str(name) for name in asked.get("hidden", [])] if isinstance(asked.get("hidden"), list) else []
        )
        background = str(asked.get("background", "#ffffff"))
        return self.server.show.picture(_wish(asked), camera_of(asked.get("camera")), hidden, background)

    def _answer(self, route: Callable[[], tuple[str, bytes]] | None, token: str) -> None:
        if self.server.hosts and self.headers.get("Host", "") not in self.server.hosts:
            self._send(HTTPStatus.FORBIDDEN, *_trouble("This server has another name.", "Use its address."))
        elif not self._is_let_in(token):
            self._send(
                HTTPStatus.FORBIDDEN, *_trouble("The token is missing or wrong.", "Open the printed address.")
            )
        elif route is None:
            self._send(HTTPStatus.NOT_FOUND, *_trouble("There is nothing here.", ""))
        else:
            try:
                kind, content = route()
            except GwError as error:
                self._send(HTTPStatus.BAD_REQUEST, *_trouble(error.what, error.fix))
                return
            self._send(HTTPStatus.OK, kind, content)

    def _is_let_in(self, token: str) -> bool:
        given = token or self.headers.get("X-Token", "")
        return not self.server.token or hmac.compare_digest(given.encode(), self.server.token.encode())

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(content)),
            "Cache-Control": "no-store",
            "Content-Security-Policy": _POLICY,
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing: the terminal belongs to the command."""


def _is_this_machine(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def _wish(asked: dict[str, Any]) -> Wish:
    """From a query, or from a posted object."""
    wear = asked.get("wear", "")
    names = wear.split(",") if isinstance(wear, str) else [str(name) for name in wear]
    try:
        motion, row = int(asked.get("motion", 0)), int(asked.get("row", 0))
    except (TypeError, ValueError) as error:
        raise UsageProblem("Motion and row are numbers.", "request", "Reload the page.") from error
    return Wish(tuple(name for name in names if name), motion, row, str(asked.get("betas", "")))


def _json(content: Any) -> tuple[str, bytes]:
    return "application/json", json.dumps(content, allow_nan=False).encode()


def _trouble(what: str, fix: str) -> tuple[str, bytes]:
    return _json({"error": what, "fix": fix})
