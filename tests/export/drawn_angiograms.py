"""Pictures with masks as experts' are stored, whose vessels are exactly what was drawn."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def write_drawn(folder: Path, count: int = 10) -> None:
    """Write pictures 1 .. ``count``, each brighter than the one before, and their masks."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(1, count + 1):
        mask = np.zeros((200, 220), np.uint8)
        cv2.line(mask, (20, 15 * k), (200, 180), 255, 9)
        cv2.line(mask, (110, 20), (60, 190), 255, 5)
        cv2.imwrite(str(folder / f"{k}_gt.png"), mask)
        cv2.imwrite(str(folder / f"{k}.png"), np.where(mask > 0, 60 + 5 * k, 180).astype(np.uint8))
