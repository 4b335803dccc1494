"""The full run fails when a requirement of docs/requirements.md has no passing test.

Tests name what they show by ``@pytest.mark.req("REQ-nn")``. The names travel with each report,
so that it works under pytest-xdist, where the reports of all processes meet in the first one.
A requirement whose tests were all skipped (no optional data, no extra) is told, not failed; a
run of a part (``-k``, ``-m``, named files, ``-x`` after a failure) checks nothing.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

from tests.requirements import TABLE, read_table

_KEY = "req"


class RequirementsPlugin:
    """Collects outcomes by requirement; lives in the first process alone."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.outcomes: dict[str, set[str]] = defaultdict(set)
        self.unmet: list[str] = []
        self.skipped: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note what a test with requirements came to."""
        if report.when == "call" or report.outcome != "passed":
            for key, value in report.user_properties:
                if key == _KEY:
                    self.outcomes[str(value)].add(report.outcome)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Compare with the table."""
        if not is_whole(self.config) or session.shouldstop or session.shouldfail:
            return
        for requirement in read_table(TABLE):
            found = self.outcomes[requirement.name]
            if "passed" in found:
                continue
            (self.skipped if found == {"skipped"} else self.unmet).append(requirement.name)
        if self.unmet and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Say it."""
        if self.unmet:
            terminalreporter.write_line(f"no passing test for {', '.join(self.unmet)}", red=True)
        if self.skipped:
            terminalreporter.write_line(f"tests skipped of {', '.join(self.skipped)}")


def is_whole(config: pytest.Config) -> bool:
    """Tell whether this run was asked for every test."""
    options = config.option
    chosen = options.keyword or options.markexpr or getattr(options, "lf", False)
    narrowed = options.deselect or options.ignore or options.ignore_glob or options.maxfail
    everything = [str(Path(config.rootpath) / name) for name in config.getini("testpaths")]
    given = [str((config.invocation_params.dir / arg).resolve()) for arg in config.args]
    return not (chosen or narrowed or options.collectonly) and given == everything


def name_requirements(items: list[pytest.Item]) -> None:
    """Let each item's reports carry the names that it is marked with."""
    for item in items:
        for mark in item.iter_markers(_KEY):
            item.user_properties += [(_KEY, name) for name in mark.args]
