"""gcar serve: a warm worker for host programs in any language."""

from __future__ import annotations

import dataclasses
import io
import os
import secrets
import signal
import sys
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import (
    Talk,
    engine_options,
    gathered,
    needs_extra,
    say,
    serve_until_stopped,
    talk_options,
)
from gcar_deploy.cli.paths import ANY_PATH
from gcar_deploy.cli.request import order_options
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.inputs.order import Order

_LEAST_TOKEN = 16
TOKEN_VARIABLE = "GCAR_TOKEN"  # noqa: S105 - the name of a variable


@dataclasses.dataclass(frozen=True)
class Door:
    """How host programs reach the worker."""

    stdio: bool
    port: int
    folder: Path | None
    token_file: Path | None


@dataclasses.dataclass(frozen=True)
class Limits:
    """What the worker takes upon itself."""

    limit: float
    body_mib: int
    waiting: int
    memory_mib: int


_DOOR = {
    "token_file": click.option(
        "--token-file", type=ANY_PATH,
        help=f"Holds the token; else {TOKEN_VARIABLE}, else one is made and printed once.",
    ),
    "folder": click.option(
        "--folder", type=ANY_PATH,
        help="Orders may name files in this folder and put results there.",
    ),
    "port": click.option(
        "--port", type=click.IntRange(0, 65535), default=0, help="Of 127.0.0.1; 0 takes a free one."
    ),
    "stdio": click.option(
        "--stdio", is_flag=True,
        help="JSON-RPC 2.0 lines on standard input and output; no network.",
    ),
}  # fmt: skip
_LIMITS = {
    "memory_mib": click.option(
        "--memory-mib", type=click.IntRange(min=1024), default=8192, show_default=True,
        help="Address space of the worker, MiB: a job that needs more fails, the worker lives on.",
    ),
    "waiting": click.option(
        "--queue", "waiting", type=click.IntRange(1, 1000), default=32, show_default=True,
        help="Jobs that may wait.",
    ),
    "body_mib": click.option(
        "--body-mib", type=click.IntRange(1, 4096), default=256, show_default=True,
        help="The largest request, MiB.",
    ),
    "limit": click.option(
        "--limit", type=click.FloatRange(min=0, min_open=True), default=120.0, show_default=True,
        metavar="SECONDS", help="The longest deadline of a job.",
    ),
}  # fmt: skip


@click.command("serve")
@gathered("door", Door, _DOOR)
@gathered("limits", Limits, _LIMITS)
@order_options("predictor", "refiner", "segmenter", "pose")
@engine_options
@talk_options("verbose")
def serve(door: Door, limits: Limits, order: Order, engine: EngineChoice, talk: Talk) -> None:
    """Keep an engine warm and reconstruct what host programs send.

    Predictor, refiner, segmenter and pose hold for orders that do not name their own.

    HTTP with JSON on 127.0.0.1 alone, behind a bearer token (GET /openapi.json describes it),
    or JSON lines with --stdio. Ctrl-C or SIGTERM ends it: open jobs are cancelled.

    \b
    Example:
      gcar serve --port 8790 --folder cases
    """  # noqa: D301 - click wants a real backspace
    talk.set_up()
    engine.limit_threads()
    token = None
    if not door.stdio:
        token = read_token(door.token_file)
        with needs_extra("serve", "flask", "waitress", "werkzeug"):
            # Found out before the engine takes its seconds.
            import gcar_deploy.worker.http  # noqa: F401
    from gcar_deploy.worker.folder import AllowedFolder
    from gcar_deploy.worker.jobs import JobQueue
    from gcar_deploy.worker.order_folders import drop_all_scratch, sweep_scratch
    from gcar_deploy.worker.orders import do_order

    allowed = None if door.folder is None else AllowedFolder(door.folder)
    # Only what will serve changes its process: a refused call leaves it as it was.
    limit_memory(limits.memory_mib)
    sweep_scratch()
    # SIGTERM, like Ctrl-C, ends a server in good order.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    warm = engine.engine(order)
    warm.warmup()

    def work(order: Any, on_progress: Any, cancel: Any) -> Any:
        return do_order(warm, order, on_progress, cancel, limit_s=limits.limit)

    def make_queue(on_change: Any = None) -> JobQueue:
        return JobQueue(work, most_waiting=limits.waiting, on_change=on_change)

    try:
        if door.stdio:
            _serve_lines(make_queue, allowed)
        else:
            _serve_http(make_queue(), allowed, token, door.port, limits.body_mib)
    finally:
        # Told twice to stop, it waits for no job; copies of pictures are not left for all that.
        drop_all_scratch()


def _serve_lines(make_queue: Any, allowed: Any) -> None:
    from gcar_deploy.worker.stdio import LineServer

    # What a library prints must not stand between the messages.
    if isinstance(sys.stdin, io.TextIOWrapper):
        # Bytes that are no text make one message unreadable, not the end of the service.
        sys.stdin.reconfigure(encoding="utf-8", errors="replace")
    private = os.dup(1)
    os.dup2(2, 1)
    with os.fdopen(private, "w", encoding="utf-8") as sink:
        try:
            LineServer(make_queue, allowed, sys.stdin, sink).run()
        except KeyboardInterrupt:
            return


def _serve_http(queue: Any, allowed: Any, token: str | None, port: int, body_mib: int) -> None:
    try:
        from gcar_deploy.worker.http import create_app
        from gcar_deploy.worker.loopback import LOOPBACK, listen

        fresh = token is None
        token = token or secrets.token_urlsafe(32)
        app = create_app(queue, token, folder=allowed, body_mib=body_mib)
        server = listen(app, port, queue.close)
        say(f"gcar: http://{LOOPBACK}:{server.effective_port}")
        if fresh:
            say(f"gcar: token {token}")
        serve_until_stopped(server)
    finally:
        queue.close()


def limit_memory(mib: int) -> None:
    """Cap the address space of this process, where the system has such a limit."""
    try:
        import resource
    except ImportError:
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    wanted = mib * 2**20
    soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def read_token(file: Path | None) -> str | None:
    """Return the token that the user gave, or None.

    Raises
    ------
    UsageError
        The file cannot be read, others may read it, or the token is short or odd.
    """
    from gcar_deploy.errors import UsageError

    if file is None:
        token, where = os.environ.get(TOKEN_VARIABLE, ""), TOKEN_VARIABLE
        if not token:
            return None
    else:
        where = str(file)
        try:
            if os.name == "posix" and file.stat().st_mode & 0o077:
                raise UsageError(f"{file} can be read by others; chmod 600 it")
            token = file.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError):
            raise UsageError(f"{file} cannot be read as a token") from None
    if len(token) < _LEAST_TOKEN or not token.isprintable() or " " in token:
        raise UsageError(f"{where}: a token has {_LEAST_TOKEN} or more characters and no spaces")
    return token
