"""Numbers, arrays, tuples and mappings as strict JSON values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def plain(value: Any, path: str, reasons: dict[str, str]) -> Any:
    """Return a value as JSON holds it: plain and finite.

    What is undefined becomes null; ``reasons`` then says why under its JSON pointer.
    """
    if isinstance(value, Mapping):
        return {str(k): plain(v, f"{path}/{k}", reasons) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v, f"{path}/{k}", reasons) for k, v in enumerate(value)]
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), path, reasons)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        reasons[path] = "not finite"
        return None
    if value is None and not path.startswith("/options"):
        reasons.setdefault(path, "not determined")
    return value
