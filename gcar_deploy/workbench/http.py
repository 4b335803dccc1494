"""HTTP face of the workbench: the page, and what it asks for, behind a token (extra ``serve``).

The page itself holds nothing of anybody's and needs no token; it gets the token behind the ``#``
of its address, which browsers send to nobody. The page's policy lets it talk to this server alone.
"""

from __future__ import annotations

import re
import threading
from http import HTTPStatus
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from flask import Flask, Response, request, send_from_directory

from gcar_deploy import __version__
from gcar_deploy.dicom.choose import choose_frame, filling_and_motion
from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.files import natural_order
from gcar_deploy.geometry.fields import MOST_VIEWS
from gcar_deploy.inputs.drawn import parse_point
from gcar_deploy.inputs.order import parse_order
from gcar_deploy.reconstruction import RESEARCH_USE
from gcar_deploy.workbench.case import RESULT_NAME, Case
from gcar_deploy.workbench.desk import Desk
from gcar_deploy.workbench.shown import (
    epipolar,
    flat_png,
    found_png,
    picture_png,
    result_data,
    thumbnail_png,
)
from gcar_deploy.workbench.trace import trace
from gcar_deploy.worker.http import found_job, shown, wait_for
from gcar_deploy.worker.jobs import JobQueue
from gcar_deploy.worker.loopback import THREADS, error, guard, tell_errors
from gcar_deploy.worker.orders import Received, suffix_of

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
_BODY_MIB = 512
_THUMBNAIL_PX = 128
_NAME_CHARACTERS = 80


def create_app(desk: Desk, queue: JobQueue, token: str, first: str | None = None) -> Flask:
    """Make the WSGI application.

    Parameters
    ----------
    desk : the cases
    queue : does the work (``desk.work``)
    token : every request but those of the page's own files must bear it
    first : name of the case to begin with; None for the start page
    """
    app = Flask("gcar-workbench", static_folder=None)
    app.config["MAX_CONTENT_LENGTH"] = _BODY_MIB * 2**20
    app.json.sort_keys = False  # type: ignore[attr-defined]
    pages = {p.name: p for p in resources.files("gcar_deploy.workbench").joinpath("page").iterdir()}

    def is_open(path: str) -> bool:
        # Result files have an address that nobody can guess.
        return path == "/" or path[1:] in pages or path.startswith("/files/")

    guard(app, token, is_open, own_pages=True)
    tell_errors(app)

    @app.get("/", defaults={"name": "index.html"})
    @app.get("/<name>")
    def page(name: str) -> Any:
        if name not in pages:
            return error("no such page", 2, HTTPStatus.NOT_FOUND)
        return Response(pages[name].read_bytes(), mimetype=_TYPES[Path(name).suffix])

    @app.after_request
    def hold(answer: Response) -> Response:
        if answer.mimetype == "text/html" and not request.path.startswith("/files/"):
            answer.headers["Content-Security-Policy"] = _POLICY
        answer.headers["Referrer-Policy"] = "no-referrer"
        return answer

    _cases(app, desk, first)
    _jobs(app, desk, queue)
    _pictures(app, desk)
    return app


def _cases(app: Flask, desk: Desk, first: str | None) -> None:
    @app.get("/api/desk")
    def whole() -> Any:
        return {"version": __version__, "use": RESEARCH_USE, "cases": desk.cases, "first": first}

    @app.post("/api/demo")
    def demo() -> Any:
        return desk.demo().described()

    @app.post("/api/cases")
    def uploaded() -> Any:
        return _uploaded(desk).described()

    @app.get("/api/cases/<case_id>")
    def described(case_id: str) -> Any:
        return _case(desk, case_id).described()

    @app.put("/api/cases/<case_id>/order")
    def correct(case_id: str) -> Any:
        case, values = _case(desk, case_id), _object()
        revision = values.pop("revision", None)
        case.correct(values, revision)
        return case.described()

    @app.get("/api/cases/<case_id>/result")
    def result(case_id: str) -> Any:
        case = _case(desk, case_id)
        if case.result is None:
            raise UsageError("there is no result yet")
        folder = case.folder / RESULT_NAME
        files = {p.name: p.stat().st_size for p in sorted(folder.iterdir()) if p.is_file()}
        return {**result_data(case.result), "files": files}


def _jobs(app: Flask, desk: Desk, queue: JobQueue) -> None:
    waiters = threading.BoundedSemaphore(THREADS // 2)

    @app.post("/api/cases/<case_id>/run")
    def run(case_id: str) -> Any:
        case = _case(desk, case_id)
        before = None if case.job_id is None else queue.get(case.job_id)
        if before is not None and before.open:
            # What it would find is no longer asked for.
            queue.cancel(before)
        order = case.ready_order
        job = queue.submit(Received(order))
        case.job_id, case.asked = job.id, order
        return _told(job, queue), HTTPStatus.ACCEPTED

    @app.get("/api/jobs/<job_id>")
    def job_of(job_id: str) -> Any:
        job = found_job(queue, job_id)
        wait_for(job, waiters)
        return _told(job, queue)

    @app.delete("/api/jobs/<job_id>")
    def cancel(job_id: str) -> Any:
        job = found_job(queue, job_id)
        queue.cancel(job)
        return _told(job, queue), HTTPStatus.ACCEPTED


def _told(job: Any, queue: JobQueue) -> dict[str, Any]:
    return {key: value for key, value in shown(job, queue).items() if key != "result"}


def _pictures(app: Flask, desk: Desk) -> None:
    @app.get("/api/cases/<case_id>/views/<int:view>/picture.png")
    def picture(case_id: str, view: int) -> Any:
        angiograms = _case(desk, case_id).angiograms()
        return _png(picture_png(angiograms[_place(view, len(angiograms))].pixels))

    @app.get("/api/cases/<case_id>/views/<int:view>/bare.png")
    def bare(case_id: str, view: int) -> Any:
        return _png(picture_png(_case(desk, case_id).bare(view)))

    @app.get("/api/cases/<case_id>/views/<int:view>/flat.png")
    def flat(case_id: str, view: int) -> Any:
        angiograms = _case(desk, case_id).judged()
        return _png(flat_png(angiograms[_place(view, len(angiograms))]))

    @app.get("/api/cases/<case_id>/views/<int:view>/found.png")
    def found(case_id: str, view: int) -> Any:
        vessels = _case(desk, case_id).vessels
        if not vessels:
            return Response(status=HTTPStatus.NO_CONTENT)
        return _png(found_png(vessels[_place(view, len(vessels))]))

    @app.get("/api/cases/<case_id>/views/<int:view>/frames")
    def frames(case_id: str, view: int) -> Any:
        case = _case(desk, case_id)
        run = case.run_of(view)
        if run is None or len(run) == 1:
            return {"frames": 1, "chosen": 1, "reason": "the only one", "filling": [1.0],
                    "motion": [0.0], "pairs": {}, "with": {}}  # fmt: skip
        filling, motion = filling_and_motion(run)
        frame = case.proposed.get(view)
        if frame is None:
            choice = choose_frame(run, None)
            chosen, reason = choice.index + 1, choice.reason
        else:
            chosen, reason = frame.number, frame.reason
        return {
            "frames": len(run), "chosen": chosen, "reason": reason,
            "filling": filling.tolist(), "motion": (motion / max(motion.max(), 1e-9)).tolist(),
            "pairs": case.scores_with(view),
            "with": {str(k): frame.number for k, frame in case.proposed.items() if k != view},
        }  # fmt: skip

    @app.get("/api/cases/<case_id>/views/<int:view>/frames/<int:frame>.png")
    def frame_of(case_id: str, view: int, frame: int) -> Any:
        case = _case(desk, case_id)
        run = case.run_of(view)
        if run is None:
            pixels = case.angiograms()[_place(view, len(case.angiograms()))].pixels
        else:
            pixels = run.decode(_place(frame, len(run), "frame"))
        return _png(thumbnail_png(pixels, _THUMBNAIL_PX))

    @app.post("/api/cases/<case_id>/views/<int:view>/epipolar")
    def lines(case_id: str, view: int) -> Any:
        case = _case(desk, case_id)
        carms, lines_of = _seen(case)
        point = parse_point("point", _object().get("point"))
        return {"views": epipolar(carms, lines_of, _place(view, len(carms)), point)}

    @app.post("/api/cases/<case_id>/views/<int:view>/trace")
    def traced(case_id: str, view: int) -> Any:
        case = _case(desk, case_id)
        angiograms, vessels = case.judged(), case.vessels
        k = _place(view, len(angiograms))
        asked = _object()
        ends = [np.array(parse_point(key, asked.get(key))) for key in ("from", "to")]
        return trace(angiograms[k], vessels[k] if vessels else None, (ends[0], ends[1]))

    @app.get("/files/<key>/<name>")
    def file_of(key: str, name: str) -> Any:
        found = desk.file(key, name)
        if found is None:
            return error("no such file", 2, HTTPStatus.NOT_FOUND)
        return send_from_directory(*found, max_age=0)


def _seen(case: Case) -> tuple[list[Any], list[Any] | None]:
    """C-arms as they were used in the last result, else as told, and the vessels' lines."""
    vessels = case.vessels
    lines = [view.skeleton for view in vessels] or None
    if case.result is not None:
        return [view.carm for view in case.result.views], lines
    return [a.carm for a in case.angiograms()], lines


def _case(desk: Desk, case_id: str) -> Case:
    case = desk.case(case_id)
    if case is None:
        raise UsageError(f"no case {case_id[:80]!r} is open")
    return case


def _place(number: int, count: int, what: str = "view") -> int:
    if not 1 <= number <= count:
        raise UsageError(f"{what} {number}: there are {count}")
    return number - 1


def _object() -> dict[str, Any]:
    found = request.get_json(silent=True)
    if not isinstance(found, dict):
        raise UsageError("the body must be a JSON object")
    return found


def _png(data: bytes) -> Response:
    return Response(data, mimetype="image/png")


def _called(name: str | None) -> str:
    """Last part of a name that a browser gave, short and printable."""
    last = re.split(r"[/\\]", name or "")[-1]
    return "".join(c for c in last if c.isprintable())[:_NAME_CHARACTERS] or "picture"


def _uploaded(desk: Desk) -> Case:
    """Make a case of the parts ``file``: pictures or runs by name, ``*.json`` is the geometry."""
    files = sorted(
        request.files.getlist("file"), key=lambda file: natural_order(Path(file.filename or ""))
    )
    scenes = [file for file in files if suffix_of(file.filename or "") == ".json"]
    views = [file for file in files if file not in scenes]
    if not 2 <= len(views) <= MOST_VIEWS or len(scenes) > 1:
        raise UsageError(
            f"{len(views)} pictures and {len(scenes)} geometry files were dropped; drop two "
            f"pictures or more (at most {MOST_VIEWS}) with one geom.json, or DICOM runs alone"
        )
    folder = desk.new_folder("case")
    names = [f"view{k}{suffix_of(file.filename or '')}" for k, file in enumerate(views, start=1)]
    try:
        for name, file in zip([*names, *["geom.json"] * len(scenes)], [*views, *scenes],
                              strict=True):  # fmt: skip
            file.save(folder / name)
        return desk.add(
            folder,
            parse_order({"views": names, **({"geometry": "geom.json"} if scenes else {})}),
            [_called(file.filename) for file in views],
        )
    except GcarError:
        for path in folder.iterdir():
            path.unlink()
        folder.rmdir()
        raise
