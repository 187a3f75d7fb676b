"""A small web server of one page: on this machine alone, or with a token for others.

Owns addresses, ports, tokens and who is let in. It serves the page and its data, and no file of
the disk by name. What the page shows is its heirs' matter.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable
from typing import Any

from pipelines.errors import DyObError

LOOPBACK = "127.0.0.1"
FIRST_PORT, N_PORTS = 7000, 100
_STOP_S = 5.0

Rules = list[tuple[Any, ...]]


class PageServer:
    """Serves from a thread of its own between `start` and `stop`.

    host: the address to listen at, by default this machine's own, which nobody else reaches; at
    any other the URL holds a random token, without which nothing is served. port: by default the
    first free one from 7000 on.
    """

    page = ""  # HTML that heirs put in

    def __init__(self, host: str | None = None, port: int | None = None) -> None:
        self.host = host or LOOPBACK
        self.token = "" if _is_loopback(self.host) else secrets.token_urlsafe(24)
        self._sockets, self.port = _bind(self.host, port)
        self._loop = asyncio.new_event_loop()
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="page-server", daemon=True)

    @property
    def url(self) -> str:
        """What to open in a browser."""
        # Listening everywhere is no address that one could go to.
        everywhere = self.host in ("0.0.0.0", "::")
        name = socket.gethostname() if everywhere else self.host
        name = f"[{name}]" if ":" in name else name
        return f"http://{name}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()
        self._started.wait()

    def stop(self) -> None:
        """End, and free the port; answers that are under way may be cut off."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(_STOP_S)

    def rules(self) -> Rules:
        """The handlers' rules, as tornado takes them: the page at the root; heirs add theirs."""
        from tornado.web import RequestHandler

        @guarded
        class Page(RequestHandler):
            def get(self) -> None:
                self.finish(self.server.page)

        return [(r"/", Page, {"server": self})]

    async def last_words(self) -> None:
        """What is still to be sent at the end; for heirs."""

    def allows(self, host_header: str, token: str) -> bool:
        """Whether a request may be answered: it holds the token, or names this very machine.

        The name matters where there is no token: a page from elsewhere whose name is made to lead
        to this machine must not read what is served here.
        """
        if self.token:
            return hmac.compare_digest(token.encode(), self.token.encode())
        name = host_header.rsplit(":", 1)[0].strip("[]")
        return name == "localhost" or _is_loopback(name)

    def _serve(self) -> None:
        from tornado.httpserver import HTTPServer
        from tornado.web import Application

        asyncio.set_event_loop(self._loop)

        async def begin() -> HTTPServer:
            application = Application(self.rules(), log_function=lambda handler: None)
            server = HTTPServer(application)
            server.add_sockets(self._sockets)
            return server

        server = self._loop.run_until_complete(begin())
        self._started.set()
        self._loop.run_forever()
        server.stop()
        self._loop.run_until_complete(self._finish(server.close_all_connections))
        self._loop.close()

    async def _finish(self, close: Callable[[], Awaitable[None]]) -> None:
        await self.last_words()
        await close()
        waiting = asyncio.all_tasks() - {asyncio.current_task()}
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)


def guarded(handler: type) -> type:
    """The handler class, letting in whom its server allows, with headers that keep pages apart."""
    from tornado.web import HTTPError

    class Guarded(handler):  # type: ignore[misc, valid-type]
        def initialize(self, server: PageServer) -> None:
            self.server = server

        def set_default_headers(self) -> None:
            self.set_header("Cache-Control", "no-store")
            self.set_header("X-Content-Type-Options", "nosniff")
            self.set_header("Referrer-Policy", "no-referrer")

        def prepare(self) -> None:
            token = self.get_query_argument("token", "")
            if not self.server.allows(self.request.host, token):
                raise HTTPError(403)

        def write_error(self, status_code: int, **kwargs: Any) -> None:
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            refused = "The address must hold the token that was printed with it."
            self.finish(refused if status_code == 403 else f"{status_code}\n")

        def log_exception(self, *about: Any) -> None:
            """Refusals are no matter for the terminal of a run."""

    return Guarded


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _bind(host: str, port: int | None) -> tuple[list[socket.socket], int]:
    """Sockets that listen, and their port. Raises DyObError where there is none to be had."""
    from tornado.netutil import bind_sockets

    ports = range(FIRST_PORT, FIRST_PORT + N_PORTS) if port is None else (port,)
    reason = ""
    for candidate in ports:
        try:
            sockets = bind_sockets(candidate, address=host)
        except OSError as error:
            reason = error.strerror or str(error)
            continue
        return sockets, sockets[0].getsockname()[1]
    where = f"{port}" if port is not None else f"{ports[0]} to {ports[-1]}"
    raise DyObError(
        f"expected to serve at {host}, port {where}, found '{reason}'; name another --port, or "
        "an address of this machine as --host"
    )
