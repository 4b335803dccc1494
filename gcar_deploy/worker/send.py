"""The way back: a result sent by C-STORE to a storage service (extra ``listen``)."""

from __future__ import annotations

import dataclasses
import logging
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pynetdicom import AE

from gcar_deploy.errors import GcarError, UsageError
from gcar_deploy.output.dicom_study import study_objects

_log = logging.getLogger(__name__)
_PEER = re.compile(r"(?P<title>[!-?A-~]{1,16})@(?P<host>[A-Za-z0-9.:_\[\]-]+):(?P<port>\d{1,5})")
_SECONDS = 30


@dataclasses.dataclass(frozen=True)
class Peer:
    """Storage service: application entity title, host, port."""

    title: str
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.title}@{self.host}:{self.port}"


def parse_peer(text: str) -> Peer:
    """Read ``AET@HOST:PORT``.

    Raises
    ------
    UsageError
        It is not of that form, or the port is not 1 .. 65535.
    """
    found = _PEER.fullmatch(text)
    if found is None or not 1 <= int(found["port"]) <= 65535:
        raise UsageError(f"--send-to {text!r} must be AET@HOST:PORT, port 1 .. 65535")
    return Peer(found["title"], found["host"].strip("[]"), int(found["port"]))


def sent_back(folder: Path, runs: Sequence[Path], peer: Peer, title: str) -> dict[str, Any]:
    """Send a result's surface, overlays and measurements; what goes wrong is told, not raised.

    Parameters
    ----------
    folder : result folder
    runs : of the study
    peer : who gets them
    title : our application entity title

    Returns
    -------
    ``sent`` (how many objects the peer took) and ``send_error`` (a sentence, or None)
    """
    try:
        objects = list(study_objects(folder, runs).values())
        with warnings.catch_warnings(action="ignore"):  # they quote values of the header
            sent, error = _send(objects, peer, title)
    except GcarError as problem:
        return {"sent": 0, "send_error": str(problem)}
    except Exception as problem:  # noqa: BLE001 - the result stands, whatever the way back does
        _log.debug("sending failed", exc_info=True)
        return {"sent": 0, "send_error": f"{peer}: {type(problem).__name__} while sending"}
    return {"sent": sent, "send_error": error}


def _send(objects: list[Any], peer: Peer, title: str) -> tuple[int, str | None]:
    """Store objects one by one; a refused kind does not keep the others back."""
    entity = AE(ae_title=title)
    entity.acse_timeout = entity.dimse_timeout = entity.network_timeout = _SECONDS
    entity.connection_timeout = _SECONDS
    for kind in sorted({str(data.SOPClassUID) for data in objects}):
        entity.add_requested_context(kind, str(objects[0].file_meta.TransferSyntaxUID))
    link = entity.associate(peer.host, peer.port, ae_title=peer.title)
    if not link.is_established:
        how = "refuses the association" if link.is_rejected else "cannot be reached"
        return 0, f"{peer} {how}"
    taken = {str(context.abstract_syntax) for context in link.accepted_contexts}
    sent, wrong = 0, None
    try:
        for data in objects:
            name = data.SOPClassUID.name
            if str(data.SOPClassUID) not in taken:
                wrong = wrong or f"{peer} does not take {name}"
                continue
            status = link.send_c_store(data)
            if "Status" not in status:
                return sent, f"{peer} gave no answer to {name}"
            # 0xB000 and its kin are warnings: the object is stored (PS3.4 B.2.3).
            if status.Status == 0 or status.Status >> 12 == 0xB:
                sent += 1
            else:
                wrong = wrong or f"{peer} refuses {name} (status 0x{status.Status:04X})"
    finally:
        link.release()
    return sent, wrong
