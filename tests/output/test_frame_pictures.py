"""frames.png: what its cells mean is written below them, and whole."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gcar_deploy.imaging.chosen_frame import FramePair
from gcar_deploy.output import frame_pictures


@pytest.mark.parametrize("shape", [(15, 15), (40, 4)])
@pytest.mark.parametrize("pale", [False, True])
def test_paler_cells_are_explained_where_there_are_any(monkeypatch, shape, pale):
    written, keep = [], frame_pictures._write

    def write(canvas, text, at):
        wide = cv2.getTextSize(text, frame_pictures._FONT, 0.5, 1)[0][0]
        if text.startswith(("pale", "frames")):
            assert at[0] + wide < canvas.shape[1] and at[1] + 4 < canvas.shape[0]
        written.append(text)
        keep(canvas, text, at)

    monkeypatch.setattr(frame_pictures, "_write", write)
    remaining = np.ones(shape, bool)
    remaining[0] = not pale
    flat = tuple(np.ones(n) for n in shape)
    pair = FramePair(
        scores=np.arange(float(np.prod(shape))).reshape(shape), remaining=remaining, chosen=(1, 1),
        margin=0.1, filling=flat, motion=flat,
    )  # fmt: skip
    grey = np.arange(4096.0, dtype=np.float32).reshape(64, 64)
    made = frame_pictures.pairs_png(pair, (grey, grey), (66.7, None))
    assert ("pale: not filled, not still" in " ".join(written)) == pale
    assert made.startswith(b"\x89PNG")
