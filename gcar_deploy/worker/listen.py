"""DICOM face of the worker: a storage service on the loopback interface (extra ``listen``).

Angiography runs arrive by C-STORE; once a sender has let go and a study has enough of them, the
study becomes one order. A sender elsewhere reaches the port through a tunnel or DICOM router.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pynetdicom import AE, evt

from gcar_deploy.config import DicomLimits
from gcar_deploy.dicom.header import CLASSIC, ENHANCED, SYNTAXES
from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.files import whole_file
from gcar_deploy.geometry.fields import MOST_VIEWS
from gcar_deploy.inputs.order import Order
from gcar_deploy.worker.jobs import Job, JobQueue
from gcar_deploy.worker.order_folders import drop_scratch, new_scratch
from gcar_deploy.worker.orders import Received

_log = logging.getLogger(__name__)
LOOPBACK = "127.0.0.1"
_VERIFICATION = "1.2.840.10008.1.1"
#: C-STORE answers (PS3.4 B.2.3)
SUCCESS, OUT_OF_RESOURCES, NOT_A_RUN = 0x0000, 0xA700, 0xA900
_UID = re.compile(r"(?=.{1,64}\Z)[0-9]+(?:\.[0-9]+)*")
#: senders at a time, and studies that may wait for more runs
MOST_SENDERS, MOST_STUDIES = 4, 64
_SECONDS = 60


@dataclasses.dataclass(eq=False)
class Study:
    """Runs of one study that have arrived: SOP instance UID to file.

    ``senders`` have not let go yet; ``told`` is how many runs there were when it was last said what
    the study waits for.
    """

    scratch: Path
    runs: dict[str, Path] = dataclasses.field(default_factory=dict)
    senders: set[Any] = dataclasses.field(default_factory=set)
    told: int = 0


class Listener:
    """Receives runs and orders reconstructions.

    Parameters
    ----------
    queue : does the orders
    out : results go to ``out/STUDY_INSTANCE_UID`` (with ``-2``, ``-3`` ... if it exists)
    title : application entity title that senders must call
    runs : a study is ordered when it has so many
    most_mib : the largest run
    say : called with a sentence of what came and what a study waits for
    """

    def __init__(
        self,
        queue: JobQueue,
        out: Path,
        *,
        title: str,
        runs: int = 2,
        most_mib: int = DicomLimits.max_bytes >> 20,
        say: Callable[[str], None] | None = None,
    ) -> None:
        if not 2 <= runs <= MOST_VIEWS:
            raise UsageError(f"runs = {runs} must be 2 .. {MOST_VIEWS}")
        self._queue, self._out = queue, out
        self._title, self._wanted, self._most_bytes = title, runs, most_mib * 2**20
        self._say = say or _log.info
        self._studies: dict[str, Study] = {}
        self._ordered: list[Job] = []
        self._lock = threading.Lock()
        self._server: Any = None

    def start(self, port: int) -> int:
        """Bind the loopback interface; return the port (0 takes a free one).

        Raises
        ------
        UsageError
            The port is taken.
        """
        entity = AE(ae_title=self._title)
        entity.require_called_aet = True
        entity.maximum_associations = MOST_SENDERS
        entity.acse_timeout = entity.dimse_timeout = entity.network_timeout = _SECONDS
        for kind in (CLASSIC, ENHANCED):
            entity.add_supported_context(kind, list(SYNTAXES))
        entity.add_supported_context(_VERIFICATION)
        handlers: list[Any] = [
            (evt.EVT_C_STORE, self._store),
            (evt.EVT_RELEASED, self._let_go),
            (evt.EVT_ABORTED, self._let_go),
            (evt.EVT_CONN_CLOSE, self._let_go),
        ]
        try:
            self._server = entity.start_server((LOOPBACK, port), block=False, evt_handlers=handlers)
        except OSError as error:
            raise UsageError(f"port {port} cannot be used ({error.strerror})") from None
        return int(self._server.server_address[1])

    def stop(self) -> None:
        """Close the port and drop what never became an order."""
        if self._server is not None:
            self._server.shutdown()
        with self._lock:
            studies, self._studies = self._studies, {}
        for uid, study in studies.items():
            if study.runs:
                self._say(f"study {uid}: {len(study.runs)} of {self._wanted} runs, dropped")
            drop_scratch(study.scratch)

    def _store(self, event: Any) -> int:
        """Keep one run as it came, not a bit of it changed."""
        data = event.encoded_dataset()
        if len(data) > self._most_bytes:
            _log.warning("a run of %d MiB is too large", len(data) >> 20)
            return OUT_OF_RESOURCES
        instance = str(event.request.AffectedSOPInstanceUID)
        try:
            study = str(event.dataset.StudyInstanceUID)
        except Exception:  # noqa: BLE001 - a damaged data set may raise anything
            return NOT_A_RUN
        if not (_UID.fullmatch(study) and _UID.fullmatch(instance)):
            return NOT_A_RUN
        with self._lock:
            if study not in self._studies and len(self._studies) >= MOST_STUDIES:
                return OUT_OF_RESOURCES
            if study not in self._studies:
                self._studies[study] = Study(new_scratch())
            found = self._studies[study]
            if instance not in found.runs and len(found.runs) >= MOST_VIEWS:
                return OUT_OF_RESOURCES
            path = found.runs.get(instance) or found.scratch / f"run{len(found.runs) + 1}.dcm"
            try:
                # A run counts once it is whole; one that is sent again is kept until then.
                with whole_file(path) as half:
                    half.write_bytes(data)
            except OSError as error:
                _log.error("study %s: a run cannot be written (%s)", study, error.strerror or error)
                return OUT_OF_RESOURCES
            found.runs[instance] = path
            found.senders.add(event.assoc)
        self._say(f"study {study}: {path.stem} received, {len(data) >> 10} KiB")
        return SUCCESS

    def _let_go(self, event: Any) -> None:
        """Order every study that is complete, once all who sent runs of it are done."""
        with self._lock:
            for waiting in self._studies.values():
                waiting.senders.discard(event.assoc)
            ready = [
                uid
                for uid, s in self._studies.items()
                if len(s.runs) >= self._wanted and not s.senders
            ]
            studies = {uid: self._studies.pop(uid) for uid in ready}
            for uid, study in studies.items():
                self._say(f"study {uid}: {len(study.runs)} runs, reconstruction begins")
                self._order(uid, study)
            for uid, study in self._studies.items():
                count = len(study.runs)
                if count != study.told and not study.senders:
                    study.told = count
                    self._say(f"study {uid}: {count} of {self._wanted} runs; waits for more")

    def _order(self, uid: str, study: Study) -> None:
        order = Order(views=tuple(study.runs.values()), out=self._free(uid))
        received = Received(order, study.scratch)
        try:
            self._ordered.append(self._queue.submit(received))
        except GcarError as error:
            _log.error("study %s: %s", uid, error)
            received.clean()

    def _free(self, uid: str) -> Path:
        """Return where no result lies, and where none that was ordered will."""
        self._ordered = [job for job in self._ordered if job.open]
        taken = {job.order.out for job in self._ordered}
        path, number = self._out / uid, 1
        while path in taken or path.exists():
            number += 1
            path = self._out / f"{uid}-{number}"
        return path


def tell(write: Callable[[str], None]) -> Callable[[Job], None]:
    """Return an ``on_change`` that writes one line of JSON for each finished study."""

    def on_change(job: Job) -> None:
        if job.open:
            return
        told = {
            "study": job.order.out.name if job.order.out else None,
            "state": job.state,
            "out": None if job.folder is None else str(job.folder),
            "status": None if job.summary is None else job.summary["status"],
            "error": job.error,
            "exit_code": job.exit_code or 0,
        }
        if job.summary is not None and "sent" in job.summary:
            told |= {key: job.summary[key] for key in ("sent", "send_error")}
        write(json.dumps(told))

    return on_change
