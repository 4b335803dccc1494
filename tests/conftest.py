"""What every room's tests share."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path

# Several test processes share the cores: a thread pool in each would only be in the others' way.
if "PYTEST_XDIST_WORKER" in os.environ:
    for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_name, "1")

# Streams of the commands that are tested are held back, as they are at most users'.
os.environ.pop("PYTHONUNBUFFERED", None)

import pytest

from tests import part_times, requirements_plugin

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
#: a busy machine starts a browser slowly
PATIENCE_MS = 240_000


@pytest.fixture(scope="session")
def chromium():
    """One browser for all tests of a process: Playwright takes no second one beside it."""
    playwright = pytest.importorskip("playwright.sync_api")
    if BROWSER is None:
        pytest.skip("no Chromium")
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"], timeout=PATIENCE_MS
        )
        yield found
        found.close()


@pytest.fixture(scope="session")
def result():
    """One reconstruction of the smallest case, without a model."""
    from gcar_deploy.config import PredictOptions, RunOptions
    from gcar_deploy.engine import Engine
    from gcar_deploy.selftest import tiny_case

    angiograms, grid, _ = tiny_case()
    options = RunOptions(predict=PredictOptions(predictor="none"))
    return Engine(options=options).reconstruct(angiograms, grid)


def data_dir() -> Path:
    """Folder with the optional large data (environment variable GCAR_DATA), or skip."""
    value = os.environ.get("GCAR_DATA", "")
    if not value or not Path(value).is_dir():
        pytest.skip("GCAR_DATA is not set to the folder with the optional data")
    return Path(value)


def of_data(*parts: str) -> Path:
    """Return part of the optional data, wherever ``GCAR_DATA`` begins; skip without it."""
    for root in (data_dir(), data_dir() / "data", data_dir().parent):
        if root.joinpath(*parts).exists():
            return root.joinpath(*parts)
    pytest.skip("the optional data has no " + "/".join(parts))


def ready_case(name: str) -> Path:
    """Return the folder of a ready-made case."""
    return of_data("cases", name)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Benchmarks measure time, which a busy machine makes meaningless: only when asked for."""
    parser.addoption("--run-benchmarks", action="store_true", help="run tests that measure time")


def pytest_configure(config: pytest.Config) -> None:
    """Requirements and times are judged where all reports meet: not in a worker of pytest-xdist."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        # A shell's background job ignores Ctrl-C, and so would every process that a test starts.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(requirements_plugin.RequirementsPlugin(config))
        config.pluginmanager.register(part_times.PartTimes())


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Quick tests first, reports name requirements, benchmarks only when asked for."""
    part_times.quick_first(items)
    requirements_plugin.name_requirements(items)
    if config.getoption("--run-benchmarks"):
        return
    skip = pytest.mark.skip(reason="needs --run-benchmarks")
    for item in items:
        if "benchmark" in item.keywords:
            item.add_marker(skip)
