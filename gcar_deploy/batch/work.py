"""One case from files to a row; whatever goes wrong with it becomes the row."""

from __future__ import annotations

import dataclasses
import functools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from gcar_deploy.engine_choice import EngineChoice
from gcar_deploy.errors import CancelledError, GcarError, RefusedError
from gcar_deploy.inputs.order import Order

#: columns of summary.csv, in order
COLUMNS = (
    "case", "status", "exit_code", "sentence", "branches", "length_mm", "gaussians",
    "separation_deg", "least_coverage", "largest_stenosis_percent", "seconds",
)  # fmt: skip
#: in a process that does cases: whether the batch is to end
_ENDING: ContextVar[Callable[[], bool] | None] = ContextVar("gcar_batch_ending", default=None)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchJob:
    """One case to be done, in plain values that travel between processes.

    Attributes
    ----------
    case : name
    order : with files and result folder by their full paths
    engine : EngineChoice
    marker : exists while the case runs, so that a process that dies names its case; or None
    fingerprint : of everything the result depends on
    """

    case: str
    order: Order
    engine: EngineChoice
    marker: str | None
    fingerprint: str


def run_case(job: BatchJob) -> dict[str, Any]:
    """Reconstruct one case and write its folder; errors are rows, not exceptions.

    Raises
    ------
    CancelledError
        The batch ends: the case is as good as never begun.
    """
    _check_wanted()
    marker = None if job.marker is None else Path(job.marker)
    if marker is not None:
        marker.touch()
    try:
        return {**_solved(job), "fingerprint": job.fingerprint}
    finally:
        if marker is not None:
            marker.unlink(missing_ok=True)


def error_row(case: str, status: str, sentence: str, exit_code: int) -> dict[str, Any]:
    """Return the row of a case without a result."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row.update(case=case, status=status, exit_code=exit_code, sentence=" ".join(sentence.split()))
    return row


def prepare_process(threads: int | None, end: Any) -> None:
    """Set up a process that does cases: interrupts belong to its parent, threads are few.

    Parameters
    ----------
    end : its ``value`` is true once the parent wants it to end
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _ENDING.set(lambda: bool(end.value))
    threading.Thread(target=_die_with_parent, daemon=True).start()
    if threads is not None:
        import cv2

        cv2.setNumThreads(threads)


def _die_with_parent() -> None:
    """End this process when its parent was killed: nobody takes its row any more."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@functools.lru_cache(maxsize=2)
def _engine(engine: EngineChoice, predictor: str | None) -> Any:
    return engine.engine(Order(predictor=predictor))


def _check_wanted() -> None:
    ending = _ENDING.get()
    if ending is not None and ending():
        raise CancelledError("the batch ends")


def _solved(job: BatchJob) -> dict[str, Any]:
    try:
        engine = _engine(job.engine, job.order.predictor)
        from gcar_deploy.engine import check_target_of, deliver

        out = job.order.out
        # A folder without a row is what an interrupted batch left.
        left = out is not None and (out / "result.json").is_file()
        order = dataclasses.replace(job.order, force=left)
        check_target_of(order)
        result = engine.reconstruct_order(order, cancel=_ENDING.get())
        deliver(result, order)
        return _row(job.case, result.summary())
    except CancelledError as error:
        _check_wanted()
        return error_row(job.case, "failed", str(error), error.exit_code)
    except RefusedError as error:
        return error_row(job.case, "refused", str(error), error.exit_code)
    except GcarError as error:
        return error_row(job.case, "failed", str(error), error.exit_code)
    except Exception as error:  # noqa: BLE001 - one broken case must not stop the rest
        return error_row(job.case, "failed", f"internal error: {type(error).__name__} {error}", 1)


def _row(case: str, summary: Mapping[str, Any]) -> dict[str, Any]:
    coverage = [view["coverage"] for view in summary["views"] if view["coverage"] is not None]
    stenoses = [branch["stenosis_percent"] for branch in summary["tree"]["branches"]]
    known = [percent for percent in stenoses if percent is not None]
    return {
        "case": case,
        "status": summary["status"],
        "exit_code": 0,
        "sentence": summary["sentence"],
        "branches": len(summary["tree"]["branches"]),
        "length_mm": round(summary["tree"]["length_mm"], 2),
        "gaussians": summary["counts"]["gaussians"],
        "separation_deg": round(summary["separation_deg"], 2),
        "least_coverage": round(min(coverage), 4) if coverage else None,
        "largest_stenosis_percent": round(max(known), 1) if known else None,
        "seconds": round(summary["seconds"]["total"], 3),
    }
