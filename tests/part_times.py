"""The quick part first, then the rest; at the end, how long each took.

One run does both, so that nothing runs twice: tests marked ``slow`` go to the end of the line,
and the clock is read when the last quick report and the last of all come in. Under pytest-xdist
the reports meet in the first process; a worker that has nothing quick left begins with the rest,
so the quick part's time is at most a little too long.
"""

from __future__ import annotations

import time
from typing import Any

import pytest

#: limits of the quick part and of all, on a quiet machine of two cores, minutes
QUICK_MIN, ALL_MIN = 2, 15


class PartTimes:
    """Seconds from the start to the last report of each part; lives in the first process alone."""

    def __init__(self) -> None:
        self.start = time.monotonic()
        self.last = {"quick": 0.0, "slow": 0.0}
        self.count = {"quick": 0, "slow": 0}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note when a test was done."""
        if report.when == "teardown":
            part = "slow" if "slow" in report.keywords else "quick"
            self.count[part] += 1
            self.last[part] = time.monotonic() - self.start

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Say it, one line."""
        everything = sum(self.count.values())
        if not everything:
            return
        parts = [f"quick part: {self.count['quick']} tests in {self.last['quick']:.0f} s"]
        if self.count["slow"]:
            parts.append(f"all: {everything} tests in {max(self.last.values()):.0f} s")
        limits = f"limits on two quiet cores: {QUICK_MIN} and {ALL_MIN} min"
        terminalreporter.write_line(f"{'; '.join(parts)} ({limits})")


def quick_first(items: list[pytest.Item]) -> None:
    """Put tests marked ``slow`` last; the order is otherwise kept."""
    items.sort(key=lambda item: "slow" in item.keywords)
