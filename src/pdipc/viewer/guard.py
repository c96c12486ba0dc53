"""Who may talk to the viewer: pages at its own address, whoever knows the token in it, and nobody else.

A browser lets every page connect to a server on this machine, and only says where the page is from (its Origin). A page from elsewhere
is refused, and so is one that does not know the token, which is new at every start: it stands in the path of the address, which the
page's own script takes for its connection. viser has no place for such checks, so the function that serves is wrapped while it starts.

What connects and does not speak HTTP (a scan of ports, TLS, a connection that is given up) is dropped; `logging` tells of it at level INFO, by
the name pdipc.viewer.connections.
"""

import dataclasses
import hmac
import http
import logging
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

LOCAL = {"localhost", "127.0.0.1", "::1"}
EVERYWHERE = {"", "0.0.0.0", "::"}  # hosts that stand for all addresses of the machine


class Guard:
    """Judges requests. host: what is served at. origins: further pages that may connect, such as "https://example.org:8443".

    Raises ValueError for an origin that is none.
    """

    def __init__(self, host: str, origins: Sequence[str] = ()):
        self.token = secrets.token_urlsafe(16)
        self.host = host
        self.origins = {_normal(origin) for origin in origins}

    def path_of(self, path: str) -> str | None:
        """What is asked for below the token; None where the token is missing or wrong."""
        given, slash, rest = path.partition("?")[0].removeprefix("/").partition("/")
        known = hmac.compare_digest(given.encode(errors="backslashreplace"), self.token.encode())
        return f"/{rest}" if known and (slash or not rest) else None

    def allows(self, origin: str | None, host: str | None) -> bool:
        """Whether a page from `origin` may connect. host: the address that the request was sent to.

        Programs other than browsers name no origin; the token is enough for them.
        """
        if origin is None:
            return True
        try:
            page = urlsplit(_normal(origin))
        except ValueError:
            return False
        if page.geturl() in self.origins or page.hostname in LOCAL:
            return True
        own = page.netloc == (host or "").lower()
        return own and (page.hostname == self.host.lower() or self.host in EVERYWHERE)

    @contextmanager
    def on_duty(self) -> Iterator[None]:
        """A server of viser that is started within is guarded."""
        from websockets.asyncio import server

        serve = server.serve

        def guarded(*args: Any, process_request: Callable, **options: Any) -> Any:
            def judged(connection: Any, request: Any) -> Any:
                path = self.path_of(request.path)
                if path is None:
                    return connection.respond(
                        http.HTTPStatus.FORBIDDEN, "The address that pdipc printed has a token; use it whole.\n"
                    )
                if not self.allows(request.headers.get("Origin"), request.headers.get("Host")):
                    return connection.respond(http.HTTPStatus.FORBIDDEN, "Pages from elsewhere may not connect.\n")
                return process_request(connection, dataclasses.replace(request, path=path))

            return serve(*args, process_request=judged, **{"logger": _logger(), **options})

        server.serve = guarded  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]


def _logger() -> logging.Logger:
    """Connections that do not become any are no errors of this program: without it, each would print a traceback."""

    def demote(record: logging.LogRecord) -> bool:
        if record.msg == "opening handshake failed":
            record.levelno, record.levelname = logging.INFO, "INFO"
            record.msg, record.exc_info = f"{record.msg}: {(record.exc_info or ['', ''])[1]}", None
        return True

    logger = logging.getLogger("pdipc.viewer.connections")
    if not logger.filters:
        logger.addFilter(demote)
    return logger


def _normal(origin: str) -> str:
    """Lower case, without a slash at the end and without the port that its scheme has anyway."""
    parts = urlsplit(origin.strip().lower().rstrip("/"))
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.path or parts.query or parts.username:
        raise ValueError(f'"{origin}" is no origin of a page; it must be like http://example.org:8080')
    usual = {"http": 80, "https": 443}[parts.scheme]
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    return f"{parts.scheme}://{host}" + ("" if parts.port in (None, usual) else f":{parts.port}")
