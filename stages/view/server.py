"""The viewer's web server: the page and what it requests. Nothing else on the machine can be reached.

    GET  /                     the page
    GET  /show                 bundles, motions, first camera (JSON)
    GET  /body?wear=a,b&betas=…                        shape, height and girth of the wearer (JSON)
    GET  /gaussians?wear=a,b&motion=0&row=3&betas=…    packed Gaussians of one frame
    GET  /stream?…             as /gaussians: frame after frame from that row on, each after its length (u32)
    GET  /preview?name=a       the picture in a bundle (PNG)
    POST /picture              {wear, motion, row, betas, camera, hidden, background} -> PNG
    POST /bundle?name=…        the bytes of a .gwg file, to be worn in this session; nothing is written

Requests contain names of the catalogue, never paths. A request is refused before anything is computed when
its `Host` is not the address of this server (so that no foreign domain name can point here), or when a page
of another origin sent it. With a token every request needs it: `?token=` for the page, a header after that.
Every request that can be read gets an answer with a status.
"""

from __future__ import annotations

import hmac
import json
import secrets
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

from stages.shared.artifacts.bundle import MAX_FILE_BYTES, decode_bundle
from stages.shared.artifacts.canonical import strict_json
from stages.shared.errors import GwError, StorageFailure, UsageProblem
from stages.shared.memory import is_memory_error
from stages.shared.web.start import viewer_script
from stages.view.session import FrameRequest, ViewerSession, camera_of

Answer = tuple[str, bytes | Iterator[bytes]]  # content type, and the content or its parts
_BINARY = "application/octet-stream"
_LONGEST_REQUEST = 64 << 10
_TIMEOUT = 30  # s, for a client that says nothing
MOST_STREAMS = 4
_NOT_FOUND = ("There is nothing here.", "")
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; worker-src blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Viewer(ThreadingHTTPServer):
    """Serves a session.

    Attributes:
        url: what to open, with the token if there is one.
    """

    daemon_threads = True

    def __init__(self, host: str, port: int, session: ViewerSession, betas: str = "") -> None:
        self.session, self.betas = session, betas
        self.token = "" if _is_this_machine(host) else secrets.token_urlsafe(18)
        self.streams = threading.BoundedSemaphore(MOST_STREAMS)
        if ":" in host:
            self.address_family = socket.AF_INET6
        try:
            super().__init__((host, port), _Connection)
        except OSError as error:
            raise StorageFailure(
                f"Cannot listen on {host} at port {port}: {error.strerror or error}.",
                f"{host}, port {port}",
                "Choose another --port (0 takes a free one), or another --host.",
            ) from error
        port = self.server_address[1]
        names = {_in_address(host), "127.0.0.1", "localhost", "[::1]"}
        self.hosts = set() if self.token else {f"{name}:{port}" for name in names}
        shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, _in_address(host))
        self.url = f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a closed tab or a broken connection is not worth a line on the terminal."""

    def page(self) -> bytes:
        """The page with its scripts inside."""
        folder = resources.files("stages.view")
        page = folder.joinpath("view.html").read_text("utf-8")
        page = page.replace("@VIEWER@", viewer_script())
        return page.replace("@VIEW@", folder.joinpath("view.js").read_text("utf-8")).encode()


class _TooLong(Exception):
    """A request has no length, or one that is not read."""


class _Connection(BaseHTTPRequestHandler):
    """One connection; it may bring several requests."""

    server: Viewer
    timeout = _TIMEOUT
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "gw", ""

    def do_GET(self) -> None:
        session = self.server.session

        def routes(path: str, query: dict[str, str]) -> Answer | None:
            if path == "/":
                return "text/html; charset=utf-8", self.server.page()
            if path == "/show":
                return _json(session.described(self.server.betas))
            if path == "/body":
                return _json(session.body(_request(query)))
            if path == "/gaussians":
                return _BINARY, session.gaussians(_request(query))
            if path == "/preview":
                return "image/png", session.catalog.preview(query.get("name", ""))
            if path == "/stream":
                return _BINARY, session.stream(_request(query))
            return None

        self._answer(routes)

    def do_POST(self) -> None:
        def routes(path: str, query: dict[str, str]) -> Answer | None:
            if path == "/picture":
                return "image/png", self._picture(self._body(_LONGEST_REQUEST))
            if path == "/bundle":
                return _json(self._add_bundle(query.get("name", "")))
            return None

        self._answer(routes)

    def _picture(self, body: bytes) -> bytes:
        try:
            content = strict_json(body)
        except (ValueError, RecursionError) as error:
            raise UsageProblem("The request is not JSON.", "request", "Reload the page.") from error
        if not isinstance(content, dict):
            raise UsageProblem("The request is not an object.", "request", "Reload the page.")
        hidden = content.get("hidden", [])
        hidden = [str(name) for name in hidden] if isinstance(hidden, list) else []
        background = str(content.get("background", "#ffffff"))
        camera = camera_of(content.get("camera"))
        return self.server.session.picture(_request(content), camera, hidden, background)

    def _add_bundle(self, name: str) -> dict[str, Any]:
        stem = name.removesuffix(".gwg")[:64] or "bundle"
        where = f"{stem}.gwg"
        bundle = decode_bundle(bytearray(self._body(MAX_FILE_BYTES)), where)
        catalog = self.server.session.catalog
        return {"name": catalog.add_bundle(stem, bundle, where), "pieces": catalog.described()}

    def _body(self, limit: int) -> bytes:
        """The body of a request of at most `limit` bytes."""
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal() and len(length) < 12 and int(length) <= limit):
            raise _TooLong
        self._unread = False
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            raise UsageProblem("The request is cut short.", "request", "Send it again.")
        return body

    def _answer(self, routes: Callable[[str, dict[str, str]], Answer | None]) -> None:
        """Check who asks, find the answer, and send it; whatever goes wrong becomes a status."""
        self._unread = self.command == "POST"
        try:
            status, kind, content = self._found(routes)
        except _TooLong:
            status, kind, content = (
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                *_trouble("The request is too long.", ""),
            )
        except GwError as error:
            status, kind, content = HTTPStatus.BAD_REQUEST, *_trouble(error.what, error.fix)
        except (ConnectionError, TimeoutError):
            self.close_connection = True
            return
        except Exception as error:  # a bug must not leave the page waiting
            what = "Memory ran out." if is_memory_error(error) else f"A bug in gw: {type(error).__name__}."
            status, kind, content = (
                HTTPStatus.INTERNAL_SERVER_ERROR,
                *_trouble(what, "Try something smaller."),
            )
        self.close_connection = self.close_connection or self._unread  # what was not read cannot be skipped
        try:
            if isinstance(content, bytes):
                self._send(status, kind, content)
            else:
                self._send_stream(kind, content)
        except OSError:  # the tab was closed
            self.close_connection = True

    def _found(
        self, routes: Callable[[str, dict[str, str]], Answer | None]
    ) -> tuple[HTTPStatus, str, bytes | Iterator[bytes]]:
        try:
            address = urlsplit(self.path)
            query = {name: values[-1] for name, values in parse_qs(address.query, max_num_fields=32).items()}
        except ValueError as error:
            raise UsageProblem("The address is not understood.", "request", "Reload the page.") from error
        refusal = self._refusal(address.netloc, query.get("token", ""))
        if refusal:
            return HTTPStatus.FORBIDDEN, *_trouble(*refusal)
        answer = routes(address.path, query)
        if answer is None:
            return HTTPStatus.NOT_FOUND, *_trouble(*_NOT_FOUND)
        return HTTPStatus.OK, *answer

    def _refusal(self, netloc: str, token: str) -> tuple[str, str] | None:
        """Why a request is refused; None for one of the viewer's own page."""
        hosts, host = self.server.hosts, self.headers.get("Host", "")
        if hosts and (host not in hosts or (netloc and netloc not in hosts)):
            return "This server has another name.", "Use its address."
        origin, site = self.headers.get("Origin"), self.headers.get("Sec-Fetch-Site", "none")
        foreign = origin is not None and origin != f"http://{host}"
        if foreign or site not in ("none", "same-origin"):
            return "Another page may not use this server.", "Open the printed address."
        sent = token or self.headers.get("X-Token", "")
        if self.server.token and not hmac.compare_digest(sent.encode(), self.server.token.encode()):
            return "The token is missing or wrong.", "Open the printed address."
        return None

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self._send_headers({"Content-Type": kind, "Content-Length": str(len(content))})
        self.wfile.write(content)

    def _send_stream(self, kind: str, frames: Iterator[bytes]) -> None:
        """Frame after frame, each after its length, until the client closes the connection."""
        if not self.server.streams.acquire(blocking=False):
            self._send(
                HTTPStatus.SERVICE_UNAVAILABLE, *_trouble("Too many pages play at once.", "Close one.")
            )
            return
        self.close_connection = True
        try:
            self.send_response(HTTPStatus.OK)
            self._send_headers({"Content-Type": kind, "Connection": "close"})
            for frame in frames:
                self.wfile.write(struct.pack("<I", len(frame)))
                self.wfile.write(frame)
        finally:
            self.server.streams.release()

    def _send_headers(self, headers: dict[str, str]) -> None:
        headers |= {
            "Cache-Control": "no-store",
            "Content-Security-Policy": _POLICY,
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing: the terminal belongs to the command."""


def _in_address(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _is_this_machine(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def _request(content: dict[str, Any]) -> FrameRequest:
    """From a query, or from a posted object. Raises UsageProblem."""
    wear = content.get("wear", "")
    names = wear.split(",") if isinstance(wear, str) else wear
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or len(names) > 32:
        raise UsageProblem("What is worn is a list of names.", "request", "Reload the page.")
    try:
        motion, row = int(content.get("motion", 0)), int(content.get("row", 0))
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageProblem("Motion and row are numbers.", "request", "Reload the page.") from error
    return FrameRequest(tuple(name for name in names if name), motion, row, str(content.get("betas", "")))


def _json(content: Any) -> tuple[str, bytes]:
    return "application/json", json.dumps(content, allow_nan=False).encode()


def _trouble(what: str, fix: str) -> tuple[str, bytes]:
    return _json({"error": what, "fix": fix})
