"""What every room's tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def data_dir() -> Path:
    """Folder with the optional large data (environment variable GCAR_DATA), or skip."""
    value = os.environ.get("GCAR_DATA", "")
    if not value or not Path(value).is_dir():
        pytest.skip("GCAR_DATA is not set to the folder with the optional data")
    return Path(value)
