"""One reconstruction for all tests of its files."""

from __future__ import annotations

import pytest

from gcar_deploy.output.bundle import render_files


@pytest.fixture(scope="session")
def files(result):
    return render_files(result)


@pytest.fixture(scope="session")
def folder(result, tmp_path_factory):
    return result.save(tmp_path_factory.mktemp("bundle") / "out")
