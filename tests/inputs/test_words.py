"""Frames, landmarks and masks as people write them."""

from __future__ import annotations

from pathlib import Path

import pytest

from gcar_deploy.errors import UsageError
from gcar_deploy.inputs.words import parse_frames, parse_landmark, parse_mask


def test_frames():
    assert parse_frames("auto") == (None,)
    assert parse_frames("7, auto,12") == (7, None, 12)
    for wrong in ("", "last", "-1", "1.5", "7,", "²", "1234567"):
        with pytest.raises(UsageError, match="frame"):
            parse_frames(wrong)


def test_landmarks():
    assert parse_landmark("1,2:3.5,4") == ((1.0, 2.0), (3.5, 4.0))
    assert parse_landmark("1,2:-:3,4") == ((1.0, 2.0), None, (3.0, 4.0))
    for wrong in ("", "1;2:3,4", "1,2:3,nan", "1,2,3:4,5", "a,b:c,d"):
        with pytest.raises(UsageError, match="landmark"):
            parse_landmark(wrong)


def test_masks():
    assert parse_mask("2:m.png") == (2, Path("m.png"))
    assert parse_mask(r"16:C:\m.png") == (16, Path(r"C:\m.png"))
    for wrong in ("", "m.png", "0:m.png", "17:m.png", "1:", "01:m.png"):
        with pytest.raises(UsageError, match="N:FILE"):
            parse_mask(wrong)
