"""JSON lines on standard input and output: JSON-RPC 2.0, one message a line.

Methods: ``reconstruct`` (params as ``orders.receive``; answered when finished),
``cancel`` ({"id": id of the request}), ``health``, ``shutdown``. Notifications: ``progress``
({"id", "stage", "share"}). Error codes above 0 are the exit codes of ``gcar run``. What comes
without an id is a notification, never answered: ``cancel`` and ``shutdown`` are done, others not.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from typing import IO, Any

from gcar_deploy import __version__
from gcar_deploy.errors import GcarError, GeometryError, UsageError
from gcar_deploy.geometry.fields import quote, read_json
from gcar_deploy.reconstruction import RESEARCH_USE
from gcar_deploy.worker.folder import AllowedFolder
from gcar_deploy.worker.jobs import DONE, Job, JobQueue, QueueFullError
from gcar_deploy.worker.orders import receive

#: characters of one message
MOST_CHARACTERS = 4 * 2**20
PARSE_ERROR, INVALID_REQUEST, UNKNOWN_METHOD, INVALID_PARAMS = -32700, -32600, -32601, -32602
#: as many jobs wait as may: the same request can be sent again
BUSY = -32000


class LineServer:
    """Serves one host through two text streams.

    Parameters
    ----------
    make_queue : called with ``on_change``; returns the JobQueue
    folder : every file must lie in it; None leaves the paths to the host
    source, sink : text streams
    """

    def __init__(
        self,
        make_queue: Callable[[Callable[[Job], None]], JobQueue],
        folder: AllowedFolder | None,
        source: IO[str],
        sink: IO[str],
    ) -> None:
        self._source, self._sink, self._folder = source, sink, folder
        self._writing = threading.Lock()
        self._asking = threading.Lock()
        self._gone = threading.Event()
        self._request_of: dict[str, Any] = {}
        self._queue = make_queue(self._changed)

    def run(self) -> None:
        """Serve until either stream ends or ``shutdown`` comes; open jobs are cancelled then."""
        try:
            while not self._gone.is_set() and (line := self._source.readline(MOST_CHARACTERS)):
                if len(line) >= MOST_CHARACTERS and not line.endswith("\n"):
                    # One order too large is no reason to leave the host without a worker.
                    while line and not line.endswith("\n"):
                        line = self._source.readline(MOST_CHARACTERS)
                    self._fail(None, INVALID_REQUEST, "the message is too long")
                elif line.strip() and not self._take(line):
                    return
        finally:
            self._queue.close()

    def _take(self, line: str) -> bool:
        """Answer one line; False ends the service."""
        try:
            # A mark of the byte order is taken as in files.
            message = read_json(line.removeprefix("\ufeff"), 4 * MOST_CHARACTERS)
        except GeometryError as error:
            told = str(error)
            self._fail(None, PARSE_ERROR, told if "not JSON" in told else f"not JSON ({told})")
            return True
        if not (
            isinstance(message, dict)
            and message.get("jsonrpc") == "2.0"
            and isinstance(message.get("method"), str)
            and _is_id(message.get("id", ""))
        ):
            text = "not one JSON-RPC 2.0 request whose id is a string or a whole number"
            self._fail(None, INVALID_REQUEST, text)
            return True
        method, params = message["method"], message.get("params", {})
        if "id" not in message:
            return self._notified(method, params)
        ident = message["id"]
        try:
            if method == "reconstruct":
                self._reconstruct(ident, params)
            elif method == "cancel":
                self._answer(ident, {"cancelled": self._cancel(params)})
            elif method == "health":
                self._answer(
                    ident,
                    {"status": "ok", "version": __version__, "jobs": self._queue.counts(),
                     "use": RESEARCH_USE},
                )  # fmt: skip
            elif method == "shutdown":
                self._answer(ident, None)
                return False
            else:
                self._fail(ident, UNKNOWN_METHOD, f"unknown method {method[:80]!r}")
        except UsageError as error:
            self._fail(ident, INVALID_PARAMS, str(error))
        except QueueFullError as error:
            self._fail(ident, BUSY, str(error))
        except GcarError as error:
            self._fail(ident, error.exit_code, str(error))
        return True

    def _notified(self, method: str, params: Any) -> bool:
        """Do what wants no answer; False ends the service."""
        if method == "cancel":
            self._cancel(params)
        return method != "shutdown"

    def _reconstruct(self, ident: Any, params: Any) -> None:
        received = receive(params, self._folder)
        if received.order.out is None:
            received.clean()
            raise UsageError("out is missing: name the folder for the result")
        # The job may be over before submit returns.
        with self._asking:
            used = ident in self._request_of.values()
            if not used:
                try:
                    self._request_of[self._queue.submit(received).id] = ident
                except QueueFullError:
                    received.clean()
                    raise
        if used:
            # With the id it would be the answer to the request at work.
            received.clean()
            self._fail(None, INVALID_REQUEST, f"id {quote(ident)} is in use")

    def _cancel(self, params: Any) -> bool:
        wanted = params.get("id") if isinstance(params, dict) else None
        if not _is_id(wanted):
            return False
        with self._asking:
            found = [job for job, ident in self._request_of.items() if ident == wanted]
        job = self._queue.get(found[0]) if found else None
        if job is None or not job.open:
            return False
        self._queue.cancel(job)
        return True

    def _changed(self, job: Job) -> None:
        with self._asking:
            ident = self._request_of.get(job.id)
            if not job.open:
                self._request_of.pop(job.id, None)
        if ident is None:
            return
        if job.open:
            params = {"id": ident, "stage": job.stage, "share": round(job.share, 4)}
            self._write({"jsonrpc": "2.0", "method": "progress", "params": params})
        elif job.state == DONE:
            self._answer(ident, {"out": str(job.folder), "result": job.summary})
        else:
            self._fail(ident, job.exit_code or 1, job.error or job.state, {"state": job.state})

    def _answer(self, ident: Any, result: Any) -> None:
        self._write({"jsonrpc": "2.0", "id": ident, "result": result})

    def _fail(self, ident: Any, code: int, message: str, data: Any = None) -> None:
        error = {"code": code, "message": " ".join(message.split())}
        if data is not None:
            error["data"] = data
        self._write({"jsonrpc": "2.0", "id": ident, "error": error})

    def _write(self, message: dict[str, Any]) -> None:
        text = json.dumps(message, allow_nan=False)
        with self._writing:
            try:
                self._sink.write(text + "\n")
                self._sink.flush()
            except (OSError, ValueError):
                # The host is gone: nobody would hear of anything done after this line.
                self._gone.set()


def _is_id(value: Any) -> bool:
    """Whether a value may name a request; to Python, true is a number."""
    return isinstance(value, (str, int)) and not isinstance(value, bool)
