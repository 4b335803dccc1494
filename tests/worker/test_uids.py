"""Identifiers from elsewhere become names of files and folders: numbers and dots alone."""

from __future__ import annotations

import pytest

pytest.importorskip("pynetdicom", reason="needs the listen extra")
from gcar_deploy.worker.listen import _UID


@pytest.mark.parametrize("uid", ["1.2.840.10008.1", "2.25.0", "1" * 64])
def test_uids_are_taken(uid):
    assert _UID.fullmatch(uid)


@pytest.mark.req("REQ-41")
@pytest.mark.parametrize("uid", ["", ".", "..", "1..2", ".1", "1.", "1/2", "1\n", "a.1", "1" * 65])
def test_what_is_no_uid_is_refused(uid):
    assert not _UID.fullmatch(uid)
