"""What every server of this machine's loopback interface holds to: token, hosts, errors, port.

Flask and waitress (extra ``serve``): the handlers are as synchronous as the engine; waitress
receives a whole request, within its limits of size, before a thread sees it. Of who does not show
the token no body is kept, and such a connection is closed after seconds, whatever drips in.
"""

from __future__ import annotations

import hmac
import io
import logging
import os
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from flask import Flask, Response, jsonify, request
from waitress import create_server
from waitress.channel import HTTPChannel
from waitress.parser import HTTPRequestParser
from waitress.task import ThreadedTaskDispatcher
from werkzeug.exceptions import HTTPException

from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.worker.jobs import QueueFullError

_log = logging.getLogger(__name__)
LOOPBACK = "127.0.0.1"
#: names by which a browser's page under someone else's name cannot call the server
HOSTS = ["127.0.0.1", "localhost"]
#: threads of the server
THREADS = 8
#: connections at once; some systems wait for 512 at most
_MOST_CONNECTIONS = 256
#: seconds that a connection which never bore the token may take for a request, or be idle
_STRANGERS_S = 10.0
_STATUS_OF = {2: 400, 3: 422, 4: 422, 5: 500, 6: 422, 7: 503, 8: 500}


def guard(
    app: Flask, token: str, is_open: Callable[[str], bool], *, own_pages: bool = False
) -> None:
    """Let in who bears the token, under a name of this machine.

    Parameters
    ----------
    is_open : whether a path is answered without a token: nothing in it is anybody's
    own_pages : whether pages that this very server gave may call it; those of others never may
    """
    expected = f"Bearer {token}".encode()
    app.config["TRUSTED_HOSTS"] = HOSTS
    app.config["BEARER"] = expected

    @app.before_request
    def check() -> Any:
        origin = request.headers.get("Origin")
        own = own_pages and origin == f"http://{request.host}"
        if origin is not None and not own:
            return error("requests of web pages are not answered", 2, HTTPStatus.FORBIDDEN)
        if request.host.rpartition(":")[0] not in HOSTS and request.host not in HOSTS:
            return error("unknown Host", 2, HTTPStatus.MISDIRECTED_REQUEST)
        given = request.headers.get("Authorization", "").encode()
        if not is_open(request.path) and not hmac.compare_digest(given, expected):
            answer = error("Authorization: Bearer TOKEN is missing or wrong", 2, 401)
            answer.headers["WWW-Authenticate"] = "Bearer"
            return answer
        return None

    @app.after_request
    def quiet(answer: Response) -> Response:
        answer.headers["Cache-Control"] = "no-store"
        answer.headers["X-Content-Type-Options"] = "nosniff"
        return answer


def tell_errors(app: Flask) -> None:
    """Answer every error with one line and the exit code of the command."""

    @app.errorhandler(QueueFullError)
    def of_queue(problem: QueueFullError) -> Response:
        return error(str(problem), problem.exit_code, HTTPStatus.SERVICE_UNAVAILABLE)

    @app.errorhandler(GcarError)
    def of_gcar(problem: GcarError) -> Response:
        return error(str(problem), problem.exit_code, _STATUS_OF.get(problem.exit_code, 500))

    @app.errorhandler(HTTPException)
    def of_http(problem: HTTPException) -> Response:
        return error(f"{problem.name}: {problem.description}", 2, problem.code or 500)

    @app.errorhandler(Exception)
    def of_bug(problem: Exception) -> Response:
        _log.error("internal error: %s", type(problem).__name__)
        _log.debug("internal error", exc_info=True)
        return error(f"internal error: {type(problem).__name__}", 1, 500)


def error(message: str, exit_code: int, status: int) -> Response:
    """Answer with one line."""
    answer = jsonify(error={"message": " ".join(message.split()), "exit_code": exit_code})
    answer.status_code = int(status)
    if status == HTTPStatus.SERVICE_UNAVAILABLE:
        answer.headers["Retry-After"] = "2"
    return answer


class _Nothing:
    """Takes the place of a body that is not kept."""

    def append(self, data: bytes) -> None:
        """Forget it."""

    def getfile(self) -> io.BytesIO:
        """Return an empty body."""
        return io.BytesIO()

    def __len__(self) -> int:
        return 0

    def close(self) -> None:
        """Do nothing."""


class _Parser(HTTPRequestParser):
    """A request whose body is kept only where its header bears the token."""

    def __init__(self, adj: Any, channel: _Channel) -> None:
        super().__init__(adj)
        self._channel = channel

    def parse_header(self, header_plus: bytes) -> None:
        super().parse_header(header_plus)
        given = self.headers.get("AUTHORIZATION", "").encode("latin-1")
        if hmac.compare_digest(given, self._channel.bearer):
            self._channel.known = True
        elif self.body_rcv is not None:
            # Received all the same, so that the client comes to read why it is turned away.
            self.body_rcv.buf = _Nothing()


class _Channel(HTTPChannel):
    """A connection; bytes that drip in do not keep it open until the token has come."""

    bearer: bytes
    known = False
    last_activity: float

    def parser_class(self, adj: Any) -> _Parser:
        return _Parser(adj, self)

    def handle_read(self) -> None:
        before = self.last_activity
        super().handle_read()
        if not self.known and self.request is not None:
            self.last_activity = before

    def readable(self) -> bool:
        busy = self.requests or self.total_outbufs_len
        if not self.known and not busy and time.time() - self.last_activity > _STRANGERS_S:
            self.will_close = True
        return bool(super().readable())


class _Threads(ThreadedTaskDispatcher):
    """Threads that are waited for at the end, once what they wait for has been stopped."""

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__()
        self._stop = stop

    def shutdown(self, cancel_pending: bool = True, timeout: float = 5) -> Any:
        self._stop()
        return super().shutdown(cancel_pending, timeout)


def listen(app: Flask, port: int, stop: Callable[[], None] = lambda: None) -> Any:
    """Bind the loopback interface.

    Parameters
    ----------
    app : Flask, guarded by ``guard``
    port : 0 takes a free one; ``server.effective_port`` tells which
    stop : called when serving ends, before requests that are being answered are waited for

    Returns
    -------
    waitress server; ``run()`` serves until interrupted, ``close()`` frees the port

    Raises
    ------
    UsageError
        The port is taken.
    """
    threads = _Threads(stop)
    try:
        server = create_server(
            app,
            _dispatcher=threads,
            host=LOOPBACK,
            port=port,
            ident="gcar",
            max_request_body_size=app.config["MAX_CONTENT_LENGTH"],
            max_request_header_size=32 * 2**10,
            channel_timeout=30,
            cleanup_interval=5,
            connection_limit=_MOST_CONNECTIONS,
            asyncore_use_poll=os.name == "posix",
            clear_untrusted_proxy_headers=True,
        )
    except OSError as error:
        raise UsageError(f"port {port} cannot be used ({error.strerror})") from None
    threads.set_thread_count(THREADS)
    server.channel_class = type("Channel", (_Channel,), {"bearer": app.config["BEARER"]})
    return server
