"""Pictures of an evaluation: nothing in them is cut off."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gcar_export.evaluate.jobs import TRUTH, sides_path
from gcar_export.evaluate.report import tree_figure

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("methods", [["ours"], ["ours", "fdk", "sart", "nerp", "hull"]])
def test_the_title_of_a_tree_figure_lies_within_it(tmp_path, methods):
    side = np.zeros((40, 120), np.uint8)
    side[10:30, ::7] = 255
    for method in (TRUTH, *methods):
        path = sides_path(tmp_path, "clinical", "imagecas-0001-left", 2, method)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), side)
    fig = tree_figure(tmp_path, "clinical", "imagecas-0001-left", 2, methods)
    fig.canvas.draw()
    title = fig._suptitle.get_window_extent()
    assert title.x0 >= 0 and title.x1 <= fig.bbox.width
