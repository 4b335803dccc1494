"""One reconstruction for all tests of its files."""

from __future__ import annotations

import pytest

from gcar_deploy.config import PredictOptions, RunOptions
from gcar_deploy.engine import Engine
from gcar_deploy.output.bundle import render_files
from gcar_deploy.selftest import tiny_case


@pytest.fixture(scope="session")
def result():
    angiograms, grid, _ = tiny_case()
    options = RunOptions(predict=PredictOptions(predictor="none"))
    return Engine(options=options).reconstruct(angiograms, grid)


@pytest.fixture(scope="session")
def files(result):
    return render_files(result)


@pytest.fixture(scope="session")
def folder(result, tmp_path_factory):
    return result.save(tmp_path_factory.mktemp("bundle") / "out")
