"""Quick tests run first, and the time of each part is told."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]
ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [(), pytest.param(("-n", "2"), marks=pytest.mark.slow)])
def test_quick_tests_go_first_and_both_times_are_told(pytester, monkeypatch, workers):
    # Other plugins are not asked, and take a second each to load.
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    pytester.makeini("[pytest]\nmarkers =\n    slow: later\n")
    pytester.makeconftest(f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from tests import part_times
def pytest_configure(config):
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(part_times.PartTimes())
def pytest_collection_modifyitems(items):
    part_times.quick_first(items)
""")
    pytester.makepyfile(
        """
import time, pytest
@pytest.mark.slow
def test_slow():
    time.sleep(1.2)
def test_quick(): pass
@pytest.mark.skip
def test_skipped(): pass
"""
    )
    plugins = ("-p", "xdist") if workers else ()
    done = pytester.runpytest_subprocess("-v", *plugins, *workers)
    text = done.stdout.str()
    assert text.index("test_quick") < text.index("test_slow") or workers
    found = re.search(r"quick part: 2 tests in (\d+) s; all: 3 tests in (\d+) s", text)
    assert found, text
    assert int(found[1]) < int(found[2])
    part = pytester.runpytest_subprocess("-m", "not slow", *plugins, *workers).stdout.str()
    assert "quick part: 2 tests" in part and "all:" not in part
