"""Server of the live view to a browser on this computer: one page, one websocket, a secret in the address.

The page loads nothing from anywhere else. The websocket takes only pages of its own origin, so that no other site that
is open in the browser can look on.
"""

from __future__ import annotations

import contextlib
import hmac
import ipaddress
import json
import math
import secrets
import select
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from tactile_bayes.errors import UsageError
from tactile_bayes.hardware.live import LiveState, colour_limits, grey_levels
from tactile_bayes.mapping.places import orientation_of
from tactile_bayes.presets import PRESSURE_WINDOW_KPA

_PAGE: Final = Path(__file__).with_name("live_page.html")
OPEN_S: Final = 4.0  #: How long a page may take to ask, and to say goodbye: the view's process waits for all of them.
CLOSE_S: Final = 0.5
MOST_OPEN: Final = 24  #: Connections at a time; nobody has as many pages open.
WAIT_S: Final = 0.1
SHED_S: Final = 0.01
_SECURITY: Final = (
    "default-src 'none'; connect-src 'self' ws://{host}; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; "
    "frame-ancestors 'none'; base-uri 'none'"
)


def address_of(text: str) -> tuple[str, int]:
    """Parse the HOST:PORT of a server that only this computer can reach: the data are a patient's."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise UsageError(f"--serve {text!r} is not HOST:PORT; give 127.0.0.1:0 for any free port")
    host = "127.0.0.1" if host in ("localhost", "") else host.strip("[]")
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise UsageError(
            f"--serve {text} can be reached from other computers; give 127.0.0.1:PORT and use an SSH tunnel"
        )
    return host, int(port)


class _Door(socket.socket):
    """A listening socket that keeps `MOST_OPEN` connections, whatever comes.

    A server of websockets ends for good when a connection cannot be accepted, for example without file descriptors.
    Beyond the limit the oldest that is no page gives way, so that whoever knows the address is let in.
    """

    def __init__(self, host: str, port: int, pages: Callable[[], set[socket.socket]]) -> None:
        super().__init__(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        self._open: list[socket.socket] = []
        self._pages = pages
        self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.bind((host, port))
        self.listen()

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; raises OSError only where this socket was closed."""
        while True:
            self._wait()
            self._open = [one for one in self._open if one.fileno() >= 0]
            if len(self._open) >= MOST_OPEN:
                pages = self._pages()
                for one in [one for one in self._open if one not in pages][:1]:
                    with contextlib.suppress(OSError):
                        one.shutdown(socket.SHUT_RDWR)  # its thread closes it
                time.sleep(SHED_S)
                continue
            with contextlib.suppress(OSError):  # its other end has gone, or the system has nothing left
                made, address = super().accept()
                self._open.append(made)
                return made, address
            time.sleep(SHED_S)

    def _wait(self) -> None:
        """Wait for somebody to knock."""
        while self.fileno() >= 0:
            with contextlib.suppress(ValueError):  # it was closed meanwhile
                if select.select([self], [], [], WAIT_S)[0]:
                    return
        raise OSError("closed")


class LiveServer:
    """Sends states to the pages whose address has the secret, a random one; port 0 takes a free one."""

    def __init__(self, host: str, port: int) -> None:
        try:
            import websockets.sync.server
        except ImportError:
            raise UsageError("--serve needs the package websockets; pip install 'tactile-bayes[live]'") from None
        self._token = secrets.token_urlsafe(24)
        self._news = threading.Condition()
        self._text, self._number, self._over = "", 0, False
        self._pages: set[Any] = set()
        try:
            self._closed = websockets.exceptions.ConnectionClosed
            self._server = websockets.sync.server.serve(
                self._talk,
                sock=_Door(host, port, self._sockets),
                process_request=self._admit,
                compression=None,
                open_timeout=OPEN_S,
                close_timeout=CLOSE_S,
            )
        except OSError as error:
            raise UsageError(f"--serve {host}:{port}: {error.strerror}; give another port, 0 for any") from None
        name, number = self._server.socket.getsockname()[:2]
        self._authority = f"[{name}]:{number}" if ":" in name else f"{name}:{number}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        """Address to open in a browser."""
        return f"http://{self._authority}/?token={self._token}"

    def show(self, state: LiveState) -> None:
        """Send a state to every page."""
        text = json.dumps(document(state), allow_nan=False)
        with self._news:
            self._text, self._number = text, self._number + 1
            self._news.notify_all()

    def close(self) -> None:
        """Tell the pages that the recording is over, and stop; pages that do not read are cut off."""
        with self._news:
            self._over = True
            self._news.notify_all()
        closing = threading.Thread(target=self._server.shutdown, daemon=True)
        closing.start()
        closing.join(CLOSE_S)
        for page in self._sockets():
            with contextlib.suppress(OSError):
                page.shutdown(socket.SHUT_RDWR)
        closing.join(CLOSE_S)

    def _sockets(self) -> set[socket.socket]:
        with self._news:
            return {page.socket for page in self._pages}

    def _admit(self, connection: Any, request: Any) -> Any:
        """Return the page or a refusal; None accepts a websocket."""
        address = urlsplit(request.path)
        given = parse_qs(address.query).get("token", [""])[0]
        if not hmac.compare_digest(given.encode(), self._token.encode()):
            return connection.respond(HTTPStatus.FORBIDDEN, "give the whole address that `record` printed\n")
        if request.headers.get_all("Host") != [self._authority]:
            return connection.respond(HTTPStatus.FORBIDDEN, "not under this name\n")
        if address.path == "/":
            return self._page(connection)
        if address.path != "/live":
            return connection.respond(HTTPStatus.NOT_FOUND, "nothing here\n")
        if request.headers.get_all("Origin") != [f"http://{self._authority}"]:
            return connection.respond(HTTPStatus.FORBIDDEN, "not from another site\n")
        return None

    def _page(self, connection: Any) -> Any:
        nonce = secrets.token_urlsafe(16)
        page = _PAGE.read_text(encoding="utf-8").replace("NONCE", nonce)
        response = connection.respond(HTTPStatus.OK, page)
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
        response.headers["Content-Security-Policy"] = _SECURITY.format(host=self._authority, nonce=nonce)
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cache-Control"] = "no-store"
        return response

    def _talk(self, connection: Any) -> None:
        """Send each new state until the page closes or the recording ends."""
        seen = 0
        with self._news:
            self._pages.add(connection)
        try:
            while True:
                with self._news:
                    while self._number == seen and not self._over:
                        self._news.wait()
                    text, seen, over = self._text, self._number, self._over
                if over:
                    return
                connection.send(text)
        except self._closed:
            return
        finally:
            with self._news:
                self._pages.discard(connection)


def document(state: LiveState) -> dict[str, Any]:
    """A state as JSON for the page."""
    known = math.isfinite(state.pressure_kpa)
    return {
        "tone": state.tone,
        "pressure_kpa": round(state.pressure_kpa, 2) if known else None,
        "window_kpa": list(PRESSURE_WINDOW_KPA),
        "figures": state.account_words,
        "size": state.size_words,
        "map": _map_document(state),
    }


def _map_document(state: LiveState) -> dict[str, Any] | None:
    """Picture row by row from its top left corner, with the overlays, in cells from that corner."""
    tactile_map = state.tactile_map
    if tactile_map is None:
        return None
    view = orientation_of(tactile_map)
    levels = view.screen(grey_levels(tactile_map.mean))
    rows, columns = levels.shape
    cells = [None if math.isnan(level) else round(255 * level) for level in levels.ravel().tolist()]
    limits = colour_limits(tactile_map.mean)
    return {
        "rows": rows,
        "columns": columns,
        "levels": cells,
        "cell_mm": tactile_map.recipe.cell_mm,
        "edges": dict(view.edges),
        "words": view.words,
        "notch": None if view.notch is None else [round(part, 4) for part in view.notch],
        "lump": None if state.lump_mm is None else [round(at, 2) for at in view.place(tactile_map, state.lump_mm)],
        "limits": None if limits is None else [float(f"{end:.3g}") for end in limits],
        "values": tactile_map.recipe.value_words,
    }
