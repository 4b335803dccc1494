"""HTTP face of the worker: JSON on the loopback interface, behind a token."""

from __future__ import annotations

import dataclasses
import threading
from http import HTTPStatus
from importlib import resources
from pathlib import Path
from typing import Any

from flask import Flask, Response, request, send_from_directory, url_for
from werkzeug.datastructures import FileStorage

from gcar_deploy import __version__
from gcar_deploy.errors import GeometryError, UsageError
from gcar_deploy.files import text_of
from gcar_deploy.geometry.fields import MOST_VIEWS, read_json
from gcar_deploy.inputs.order import parse_order
from gcar_deploy.reconstruction import RESEARCH_USE
from gcar_deploy.worker.folder import AllowedFolder
from gcar_deploy.worker.jobs import DONE, Job, JobQueue, QueueFullError
from gcar_deploy.worker.loopback import THREADS, error, guard, tell_errors
from gcar_deploy.worker.order_folders import drop_scratch, new_scratch
from gcar_deploy.worker.orders import Received, placed, receive, scratch_file

#: answered without a token: nothing in them is anybody's
_OPEN = ("/health", "/openapi.json")
#: the longest that a request waits for its job, seconds
MOST_WAIT_S = 60.0
#: geometry and options of one request, bytes
_MOST_FIELDS = 4 * 2**20


def create_app(
    queue: JobQueue, token: str, *, folder: AllowedFolder | None = None, body_mib: int = 256
) -> Flask:
    """Make the WSGI application.

    Parameters
    ----------
    queue : does the work
    token : every request but ``/health`` and ``/openapi.json`` must bear it
    folder : where orders may name files; None takes uploads alone
    body_mib : the largest request
    """
    app = Flask("gcar", static_folder=None)
    app.config.update(
        MAX_CONTENT_LENGTH=body_mib * 2**20,
        MAX_FORM_MEMORY_SIZE=_MOST_FIELDS,
        MAX_FORM_PARTS=2 * MOST_VIEWS + 2,
    )
    app.json.sort_keys = False  # type: ignore[attr-defined]
    waiters = threading.BoundedSemaphore(THREADS // 2)
    guard(app, token, _OPEN.__contains__)
    tell_errors(app)

    @app.get("/health")
    def health() -> Any:
        return {"status": "ok", "version": __version__, "jobs": queue.counts(), "use": RESEARCH_USE}

    @app.get("/openapi.json")
    def openapi() -> Response:
        text = resources.files("gcar_deploy.worker").joinpath("openapi.json").read_text("utf-8")
        return Response(text.replace("__VERSION__", __version__), mimetype="application/json")

    @app.post("/v1/reconstruct")
    def reconstruct() -> Any:
        received = _received(folder)
        try:
            job = queue.submit(received)
        except QueueFullError:
            received.clean()
            raise
        wait_for(job, waiters)
        place = url_for("job_of", job_id=job.id)
        return shown(job, queue), HTTPStatus.ACCEPTED if job.open else 200, {"Location": place}

    @app.get("/v1/jobs/<job_id>")
    def job_of(job_id: str) -> Any:
        job = found_job(queue, job_id)
        wait_for(job, waiters)
        return shown(job, queue)

    @app.delete("/v1/jobs/<job_id>")
    def cancel(job_id: str) -> Any:
        job = found_job(queue, job_id)
        if job.open:
            queue.cancel(job)
            return shown(job, queue), HTTPStatus.ACCEPTED
        queue.forget(job)
        return "", HTTPStatus.NO_CONTENT

    @app.get("/v1/jobs/<job_id>/files/<name>")
    def file_of(job_id: str, name: str) -> Any:
        job = found_job(queue, job_id)
        if job.state != DONE or job.folder is None or name not in _files(job):
            return error(f"job {job_id} has no file {name!r}", 2, HTTPStatus.NOT_FOUND)
        return send_from_directory(job.folder, name, max_age=0)

    return app


def found_job(queue: JobQueue, job_id: str) -> Job:
    """Return a job that is remembered; else the answer is 404."""
    job = queue.get(job_id)
    if job is None:
        from werkzeug.exceptions import NotFound

        raise NotFound("no such job; finished jobs are forgotten after a while")
    return job


def wait_for(job: Job, waiters: threading.BoundedSemaphore) -> None:
    """Wait for the job as long as ``?wait=SECONDS`` asks, if a thread can be spared."""
    text = request.args.get("wait", "0")
    try:
        seconds = float(text)
        if not 0 <= seconds <= MOST_WAIT_S:
            raise ValueError
    except ValueError:
        raise UsageError(f"wait = {text!r} must be 0 .. {MOST_WAIT_S:g} seconds") from None
    if seconds and job.open and waiters.acquire(blocking=False):
        try:
            job.finished.wait(seconds)
        finally:
            waiters.release()


def shown(job: Job, queue: JobQueue) -> dict[str, Any]:
    """Return what a client may know of a job, as JSON values."""
    return {
        "id": job.id,
        "state": job.state,
        "stage": job.stage,
        "share": round(job.share, 4),
        "ahead": queue.ahead(job),
        "seconds": job.seconds,
        "error": None if job.error is None else {"message": job.error, "exit_code": job.exit_code},
        "out": None if job.received.private else str(job.order.out),
        "files": _files(job),
        "result": job.summary,
    }


def _files(job: Job) -> list[str]:
    if job.state != DONE or job.folder is None or not job.folder.is_dir():
        return []
    return sorted(path.name for path in job.folder.iterdir() if path.is_file())


def _received(folder: AllowedFolder | None) -> Received:
    """Read the order of a request; without ``out`` its result stays in the private folder."""
    if request.mimetype == "application/json":
        values = _strict(request.get_data(cache=False), "the body")
        if folder is None:
            raise UsageError("this worker takes uploads alone: it was started without --folder")
        found = receive(values, folder)
    elif request.mimetype == "multipart/form-data":
        found = _uploaded(folder)
    else:
        raise UsageError("send multipart/form-data or application/json")
    if found.order.out is not None or found.scratch is None:
        return found
    order = dataclasses.replace(found.order, out=found.scratch / "result")
    return dataclasses.replace(found, order=order)


def _uploaded(folder: AllowedFolder | None) -> Received:
    """Read an order of parts: ``view`` (in order), and at will masks, geometry and options."""
    options = _json("options", "{}")
    if not isinstance(options, dict):
        raise UsageError("part options must be an object")
    if options.keys() & {"views", "geometry", "masks"}:
        raise UsageError("options: views, geometry and masks are parts of their own")
    # Only DICOM views may do without; the engine says so.
    geometry = _json("geometry", "null")
    if not isinstance(geometry, (dict, type(None))):
        raise UsageError("part geometry must be the content of a geom.json")
    views, masks = _uploads()
    order = parse_order(
        {
            **options,
            "geometry": geometry,
            "views": [str(scratch_file(Path(), name, f.filename)) for name, f in views.items()],
            "masks": {
                name[4:]: str(scratch_file(Path(), name, f.filename)) for name, f in masks.items()
            },
        }
    )
    if order.out is not None:
        if folder is None:
            raise UsageError("out needs a worker that was started with --folder")
        order = placed(order, folder)
    files = views | masks
    scratch = new_scratch()

    def saved(name: str, path: Path) -> Path:
        files[name].save(scratch / path)
        return scratch / path

    try:
        return Received(order.with_files(saved), scratch, folder)
    except BaseException:
        drop_scratch(scratch)
        raise


def _uploads() -> tuple[dict[str, FileStorage], dict[str, FileStorage]]:
    """Return the pictures and the masks of a form: ``view1`` ... and ``mask1`` ... -> upload."""
    views = {f"view{k}": file for k, file in enumerate(request.files.getlist("view"), start=1)}
    names = [f"mask{k}" for k in range(1, MOST_VIEWS + 1)]
    masks = {name: request.files[name] for name in names if name in request.files}
    unknown = (set(request.files) | set(request.form)) - {"view", "geometry", "options", *masks}
    if unknown:
        raise UsageError(
            f"unknown part {sorted(unknown)[0]!r}; known: view, geometry, options, mask1 ..."
        )
    if not 2 <= len(views) <= MOST_VIEWS:
        raise UsageError(f"{len(views)} parts named view; 2 .. {MOST_VIEWS} are taken")
    return views, masks


def _json(part: str, default: str) -> Any:
    """JSON of a form field, or of a small file of that name."""
    data = request.form.get(part, default).encode("utf-8", "surrogatepass")
    if part in request.files:
        data = request.files[part].stream.read(_MOST_FIELDS + 1)
        if len(data) > _MOST_FIELDS:
            raise UsageError(f"part {part}: larger than {_MOST_FIELDS >> 20} MiB")
    return _strict(data, f"part {part}")


def _strict(data: bytes, what: str) -> Any:
    """JSON without NaN or repeated keys."""
    try:
        return read_json(text_of(data), _MOST_FIELDS)
    except (ValueError, GeometryError) as problem:
        raise UsageError(f"{what} is not JSON ({problem})") from None
