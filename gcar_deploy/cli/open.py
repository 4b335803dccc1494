"""gcar open: the workbench in the browser."""

from __future__ import annotations

import dataclasses
import functools
import secrets
import threading
import webbrowser
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import (
    Talk,
    engine_options,
    needs_extra,
    serve_until_stopped,
    talk_options,
)
from gcar_deploy.cli.paths import pictures
from gcar_deploy.cli.request import METHOD, READING, order_options
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.inputs.order import Order, check_view_numbers

_FOLDER = Path("gcar-cases")


@click.command("open")
@pictures("views", metavar="[VIEW ... | FOLDER]")
@order_options("out", *METHOD, *READING, "file")
@click.option("--no-browser", is_flag=True, help="Print the address; open nothing.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=0, help="Of 127.0.0.1; 0 takes a free one."
)
@engine_options
@talk_options("verbose")
def open_(order: Order, no_browser: bool, port: int, engine: EngineChoice, talk: Talk) -> None:
    """See a case in the browser, correct it, run it again.

    Without an argument there is a start page: the demo in one click, or drop files. With pictures
    or DICOM runs, or their folder, the case is opened; with the folder of an earlier case that one;
    with any other result folder its report. Each case has a folder below --out (gcar-cases by
    default) with the result and order.json, which holds every correction:
    gcar run --order CASE/order.json makes the same files again.

    The server listens on 127.0.0.1 alone and answers who bears its token, a part of the address.
    Ctrl-C ends it.

    \b
    Example:
      gcar open
      gcar open view1.png view2.png --geom geom.json
      gcar open gcar-cases/demo
    """  # noqa: D301 - click wants a real backspace
    talk.set_up()
    engine.limit_threads()
    with needs_extra("serve", "flask", "waitress", "werkzeug"):
        from gcar_deploy.workbench.http import create_app
    from gcar_deploy.workbench.desk import Desk
    from gcar_deploy.worker.jobs import JobQueue
    from gcar_deploy.worker.loopback import LOOPBACK, listen

    desk = Desk((order.out or _FOLDER).absolute())
    first, shelved = _first(desk, order)
    warm = engine.engine(Order())
    # While the start page is read, the first of everything is loaded.
    threading.Thread(target=warm.warmup, name="gcar-warmup", daemon=True).start()
    queue = JobQueue(functools.partial(desk.work, warm))
    try:
        token = secrets.token_urlsafe(32)
        server = listen(create_app(desk, queue, token, first), port, queue.close)
        host = f"http://{LOOPBACK}:{server.effective_port}"
        address = f"{host}/files/{shelved}/report.html" if shelved else f"{host}/#{token}"
        click.echo(address)
        if not no_browser:
            webbrowser.open(address)
        serve_until_stopped(server)
    finally:
        queue.close()


def _of_folder(order: Order, folder: Path) -> Order:
    """Return the order of the pictures in a folder, in the order of the numbers in their names."""
    from gcar_deploy.dicom.header import is_dicom
    from gcar_deploy.errors import UsageError
    from gcar_deploy.files import natural_order
    from gcar_deploy.imaging.read import SUFFIXES
    from gcar_deploy.workbench.case import ORDER_NAME

    found = sorted((path for path in folder.iterdir() if path.is_file()), key=natural_order)
    pictures = tuple(p for p in found if p.suffix.lower() in SUFFIXES or is_dicom(p))
    scene = folder / "geom.json"
    if len(pictures) < 2:
        raise UsageError(
            f"{folder} holds no case ({ORDER_NAME}), no result (report.html) and no pictures of "
            "two views"
        )
    geometry = scene if order.geometry is None and scene.is_file() else order.geometry
    return dataclasses.replace(order, views=pictures, geometry=geometry)


def _first(desk: Any, order: Order) -> tuple[str | None, str | None]:
    """Put on the desk what the command names; return the case's name, or the key of a result."""
    from gcar_deploy.errors import ImageError
    from gcar_deploy.files import is_folder, is_there
    from gcar_deploy.imaging.read import check_opens
    from gcar_deploy.workbench.case import ORDER_NAME
    from gcar_deploy.workbench.desk import absolute, case_folder

    views = order.views
    if not views:
        return None, None
    if len(views) == 1 and is_folder(views[0]):
        folder = views[0]
        if (case_folder(folder) / ORDER_NAME).is_file():
            return str(desk.again(folder).id), None
        if (folder / "report.html").is_file():
            return None, str(desk.shelve(folder))
        order = _of_folder(order, folder)
    elif len(views) == 1 and not is_there(views[0]):
        raise ImageError(f"{views[0]}: no such file or folder; check the path")
    check_view_numbers(order)
    for path in order.files.values():
        # The page would open, and show that nothing is there.
        if not is_there(path):
            raise ImageError(f"{path}: no such file; check the path")
        if not is_folder(path):
            check_opens(path)
    return str(desk.add(desk.new_folder("case"), absolute(order)).id), None
