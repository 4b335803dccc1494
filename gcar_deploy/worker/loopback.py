"""What every server of this machine's loopback interface holds to: token, hosts, errors, port.

Flask and waitress (extra ``serve``): the handlers are as synchronous as the engine; waitress
receives a whole request, within its limits of size and time, before a thread sees it.
"""

from __future__ import annotations

import hmac
import logging
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from flask import Flask, Response, jsonify, request
from waitress import create_server
from werkzeug.exceptions import HTTPException

from gcar_deploy.errors import GcarError, UsageError

_log = logging.getLogger(__name__)
LOOPBACK = "127.0.0.1"
#: names by which a browser's page under someone else's name cannot call the server
HOSTS = ["127.0.0.1", "localhost"]
#: threads of the server
THREADS = 8
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


def listen(app: Flask, port: int) -> Any:
    """Bind the loopback interface.

    Parameters
    ----------
    port : 0 takes a free one; ``server.effective_port`` tells which

    Returns
    -------
    waitress server; ``run()`` serves until interrupted, ``close()`` frees the port

    Raises
    ------
    UsageError
        The port is taken.
    """
    try:
        return create_server(
            app,
            host=LOOPBACK,
            port=port,
            threads=THREADS,
            ident="gcar",
            max_request_body_size=app.config["MAX_CONTENT_LENGTH"],
            max_request_header_size=32 * 2**10,
            channel_timeout=30,
            cleanup_interval=5,
            connection_limit=64,
            clear_untrusted_proxy_headers=True,
        )
    except OSError as error:
        raise UsageError(f"port {port} cannot be used ({error.strerror})") from None
