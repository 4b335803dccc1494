"""gcar listen: a DICOM storage service that reconstructs what it receives."""

from __future__ import annotations

import dataclasses
import signal
import threading
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import (
    Talk,
    engine_options,
    gathered,
    needs_extra,
    say,
    talk_options,
    until_stopped,
)
from gcar_deploy.cli.paths import ANY_PATH
from gcar_deploy.cli.request import order_options
from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.geometry.fields import LEAST_VIEWS, MOST_VIEWS
from gcar_deploy.inputs.order import Order


@dataclasses.dataclass(frozen=True)
class Service:
    """What the storage service is called, when it acts, and where results go beside the folder."""

    port: int
    title: str
    runs: int
    send_to: str | None
    once: bool
    limit: float


_SERVICE = {
    "limit": click.option(
        "--limit", type=click.FloatRange(min=0, min_open=True), default=300.0, show_default=True,
        metavar="SECONDS", help="Deadline of a reconstruction.",
    ),
    "once": click.option("--once", is_flag=True, help="End after the first study."),
    "send_to": click.option(
        "--send-to", metavar="AET@HOST:PORT",
        help="Send surface, overlays and measurements back into the study by C-STORE.",
    ),
    "runs": click.option(
        "--runs", type=click.IntRange(LEAST_VIEWS, MOST_VIEWS), default=2, show_default=True,
        help="A study with so many runs is reconstructed.",
    ),
    "title": click.option(
        "--title", default="GCAR", show_default=True, help="Our application entity title."
    ),
    "port": click.option(
        "--port", type=click.IntRange(0, 65535), default=11112, show_default=True,
        help="Of 127.0.0.1; 0 takes a free one.",
    ),
}  # fmt: skip


@click.command("listen")
@click.option("--out", "out_dir", required=True, type=ANY_PATH, help="Folder of results.")
@gathered("service", Service, _SERVICE)
@order_options("predictor", "refiner", "segmenter", "pose", "pixel_spacing_mm", "sod_mm")
@engine_options
@talk_options("verbose")
def listen(out_dir: Path, service: Service, order: Order, engine: EngineChoice, talk: Talk) -> None:
    """Receive angiography runs by DICOM C-STORE and reconstruct each study.

    Listens on 127.0.0.1 alone. When a sender lets go and a study has enough runs, its result
    appears as OUT/STUDY_INSTANCE_UID, and one line of JSON on stdout says so. What has arrived and
    what a study waits for is said on stderr. With --send-to the surface (Encapsulated STL), the
    overlays (Secondary Capture) and the measurements (Comprehensive 3D SR) also go to a storage
    service, as new series of the same study and patient; the folder is kept whatever that service
    answers. Ctrl-C or SIGTERM ends it.

    \b
    Example:
      gcar listen --out results
      storescu -xs -aec GCAR 127.0.0.1 11112 run1.dcm run2.dcm

    That storescu is DCMTK's; pynetdicom brings another of the same name, which wants -cx for -xs.
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import UsageError

    talk.set_up()
    engine.limit_threads()
    title = service.title
    if not (title.isascii() and title.isprintable() and 1 <= len(title.strip()) <= 16):
        raise UsageError(f"--title {title!r} must be 1 .. 16 plain characters")
    with needs_extra("listen", "pynetdicom", "pydicom", "highdicom"):
        from gcar_deploy.worker.listen import LOOPBACK, Listener, tell
        from gcar_deploy.worker.send import parse_peer, sent_back
    from gcar_deploy.worker.jobs import Job, JobQueue
    from gcar_deploy.worker.order_folders import sweep_scratch
    from gcar_deploy.worker.orders import do_order

    peer = None if service.send_to is None else parse_peer(service.send_to)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{out_dir} cannot be made ({error.strerror})") from None
    sweep_scratch()
    warm = engine.engine(order)
    warm.warmup()
    over = threading.Event()
    said = tell(lambda line: click.echo(line))

    def on_change(job: Job) -> None:
        try:
            said(job)
        finally:
            if service.once and not job.open:
                over.set()

    def work(order: Any, on_progress: Any, cancel: Any) -> Any:
        summary, folder = do_order(warm, order, on_progress, cancel, limit_s=service.limit)
        if peer is not None:
            summary |= sent_back(folder, order.views, peer, title)
            if summary["send_error"]:
                say(f"gcar: not sent: {summary['send_error']}")
        return summary, folder

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    queue = JobQueue(work, on_change=on_change)
    listener = Listener(
        queue, out_dir, title=title, runs=service.runs,
        say=lambda line: say(f"gcar: {line}"),
    )  # fmt: skip
    try:
        with until_stopped():
            found = listener.start(service.port)
            say(f"gcar: {title} on {LOOPBACK}:{found}")
            over.wait()
    finally:
        listener.stop()
        queue.close()
