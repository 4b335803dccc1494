"""The battery sees what it looks for: a crash, a hang, a large memory, a traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = """
import os, signal, sys, time
from tests.battery.pool import FoundError, Limits, run_cases
def case(index, folder):
    if index == 1: os.kill(os.getpid(), signal.SIGSEGV)
    if index == 2:
        while True: pass
    if index == 3: bytearray(3 * 2**30)
    if index == 4: {}["missing"]
    if index == 5: raise FoundError("left behind")
    if index == 6: time.sleep(600)
    return "fine"
tally = run_cases(case, 0, 6, Limits(cpu_s=0.5))
# A case that only sleeps is alone in its child: no busy machine can make it end in time.
tally.add(run_cases(case, 6, 1, Limits(wall_s=2.0)))
tally.add(run_cases(case, 7, 2, Limits(cpu_s=0.5)))
for line in tally.findings: print(line)
print(tally.cases, tally.outcomes["fine"])
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="forks and POSIX limits")
def test_what_goes_wrong_is_counted_and_the_rest_goes_on():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, cwd=ROOT, timeout=300,
        check=True,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    for index, words in enumerate(
        ("signal 11", "time-out", "out of memory", "KeyError", "left behind", "time-out"), start=1
    ):
        assert lines[index - 1].startswith(f"case {index}: FINDING") and words in lines[index - 1]
    assert lines[-1] == "9 3"
