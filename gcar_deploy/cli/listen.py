"""gcar listen: a DICOM storage service that reconstructs what it receives."""

from __future__ import annotations

import dataclasses
import signal
import threading
from pathlib import Path
from typing import Any

import click

from gcar_deploy.cli.common import (
    chosen_dicom,
    limit_threads,
    needs_extra,
    predictor_options,
    run_options,
    set_up_logging,
)


@click.command("listen")
@click.option(
    "--out", "out_dir", required=True, type=click.Path(path_type=Path), help="Folder of results."
)
@click.option(
    "--port", type=click.IntRange(0, 65535), default=11112, show_default=True,
    help="Of 127.0.0.1; 0 takes a free one.",
)  # fmt: skip
@click.option("--title", default="GCAR", show_default=True, help="Our application entity title.")
@click.option(
    "--runs", type=click.IntRange(2, 16), default=2, show_default=True,
    help="A study with so many runs is reconstructed.",
)  # fmt: skip
@click.option(
    "--send-to", default=None, metavar="AET@HOST:PORT",
    help="Send surface and overlays back into the study by C-STORE.",
)  # fmt: skip
@click.option("--once", is_flag=True, help="End after the first study.")
@click.option(
    "--limit", type=click.FloatRange(min=0, min_open=True), default=300.0, show_default=True,
    metavar="SECONDS", help="Deadline of a reconstruction.",
)  # fmt: skip
@click.option(
    "--pixel-spacing", "spacing", type=click.FloatRange(0.02, 10), default=None, metavar="MM",
    help="DICOM without it: pixel spacing at the detector.",
)  # fmt: skip
@click.option(
    "--sod", type=click.FloatRange(300, 5000), default=None, metavar="MM",
    help="DICOM without it: source to isocentre.",
)  # fmt: skip
@predictor_options
@click.option("-v", "--verbose", is_flag=True, help="Say more on stderr.")
def listen(
    out_dir: Path,
    port: int,
    title: str,
    runs: int,
    send_to: str | None,
    once: bool,
    limit: float,
    spacing: float | None,
    sod: float | None,
    predictor: str,
    model: str | None,
    refiner: str,
    threads: int | None,
    verbose: bool,
) -> None:
    """Receive angiography runs by DICOM C-STORE and reconstruct each study.

    Listens on 127.0.0.1 alone. When a sender lets go and a study has enough runs, its result
    appears as OUT/STUDY_INSTANCE_UID, and one line of JSON on stdout says so. With --send-to the
    surface (Encapsulated STL) and the overlays (Secondary Capture) also go to a storage service,
    as new series of the same study and patient; the folder is kept whatever that service answers.
    Ctrl-C or SIGTERM ends it.

    \b
    Example:
      gcar listen --out results
      storescu -aec GCAR 127.0.0.1 11112 run1.dcm run2.dcm
    """  # noqa: D301 - click wants a real backspace
    from gcar_deploy.errors import UsageError

    set_up_logging(verbose, quiet=False)
    limit_threads(threads)
    if not (title.isascii() and title.isprintable() and 1 <= len(title.strip()) <= 16):
        raise UsageError(f"--title {title!r} must be 1 .. 16 plain characters")
    with needs_extra("listen", "pynetdicom", "pydicom"):
        from gcar_deploy.worker.listen import LOOPBACK, Listener, tell
        from gcar_deploy.worker.send import parse_peer, sent_back
    from gcar_deploy.engine import Engine
    from gcar_deploy.worker.jobs import Job, JobQueue
    from gcar_deploy.worker.orders import do_order

    peer = None if send_to is None else parse_peer(send_to)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{out_dir} cannot be made ({error.strerror})") from None
    options = run_options(predictor, refiner)
    options = dataclasses.replace(options, dicom=chosen_dicom("auto", spacing, sod))
    engine = Engine(model, threads=threads, options=options)
    engine.warmup()
    over = threading.Event()
    said = tell(lambda line: click.echo(line))

    def on_change(job: Job) -> None:
        said(job)
        if once and not job.open:
            over.set()

    def work(order: Any, on_progress: Any, cancel: Any) -> Any:
        summary, folder = do_order(engine, order, on_progress, cancel, limit_s=limit)
        if peer is not None:
            summary |= sent_back(folder, order.views[0], peer, title)
            if summary["send_error"]:
                click.echo(f"gcar: not sent: {summary['send_error']}", err=True)
        return summary, folder

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    queue = JobQueue(work, on_change=on_change)
    listener = Listener(queue, out_dir, title=title, runs=runs)
    try:
        found = listener.start(port)
        click.echo(f"gcar: {title} on {LOOPBACK}:{found}", err=True)
        over.wait()
    except KeyboardInterrupt:
        click.echo("gcar: stopping", err=True)
    finally:
        listener.stop()
        queue.close()
