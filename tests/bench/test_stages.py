"""The table of stages: what it says is what the processes did."""

import pytest

from gcar_deploy.bench import stages
from gcar_deploy.reconstruct import STAGES


def test_medians_and_table():
    warm = stages.medians([{"refine": s, "total": 2 * s} for s in (1.0, 5.0, 2.0)])
    assert warm == {"refine": 2.0, "total": 4.0}
    cold = {"imports": 0.5, "model": 0.1, "refine": 3.0, "total": 4.5, "files": 1.0}
    whole = {stages.WHOLE: 7.0, stages.LIBRARIES: 0.5, stages.PEAK: 280.4}
    lines = stages.table({**cold, **whole}, warm).splitlines()
    assert lines[2:] == [
        "| imports | 0.50 | - |",
        "| model | 0.10 | - |",
        "| refine | 3.00 | 2.00 |",
        "| pictures to tree | 4.50 | 4.00 |",
        "| files | 1.00 | - |",
        "| whole process | 7.00 | - |",
        "| import numpy, cv2, onnxruntime | 0.50 | - |",
        "",
        "whole process: 14.0 times these imports",
        "",
        "peak resident memory: 280 MB",
    ]


@pytest.mark.slow
def test_a_cold_process_holds_its_stages():
    shares = []
    cold, warm = stages.stage_seconds(1, 1, shares.append)
    names = {name for name, _ in STAGES}
    assert names <= warm.keys() and names <= cold.keys()
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1.0)
    assert all(seconds >= 0 for seconds in cold.values())
    assert {*stages.BEFORE, *stages.AFTER, stages.WHOLE, stages.LIBRARIES} <= cold.keys()
