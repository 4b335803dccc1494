"""The smallest case: pictures, what is found in them, and the true tree."""

from __future__ import annotations

import pytest

from gcar_deploy.config import ImagingOptions
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.selftest import tiny_case


@pytest.fixture(scope="session")
def case():
    angiograms, _, tree = tiny_case()
    return angiograms, [extract_vessels(a, ImagingOptions()) for a in angiograms], tree
