"""What is said in several places is said in the same words, and is so."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np

from gcar_deploy.output import dicom_sr
from gcar_deploy.output.colors import SCALE
from gcar_deploy.output.words import GHOST
from gcar_deploy.quality import GHOST_MM

ROOT = Path(__file__).parents[2]
#: primaries by their names
NAMED = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "yellow": (1, 1, 0)}


def named(color):
    """The primary that a colour looks like."""
    share = np.array(color) / max(color)
    return min(NAMED, key=lambda name: np.linalg.norm(share - NAMED[name]))


def test_the_tour_names_the_colours_of_the_reports_lines():
    tour = " ".join((ROOT / "docs" / "tour.md").read_text(encoding="utf-8").split())
    low, high = map(named, SCALE)
    assert (
        f"tree, {low} where it lies on the picture's vessels, {high} from 2 mm off; red is" in tour
    )


def test_a_branches_figure_of_a_ghost_means_the_same_everywhere(files, result):
    """A share of its length, as the schema has it, not the odds that all of it is one."""
    assert f"more than {GHOST_MM:g} mm" in GHOST
    page = resources.files("gcar_deploy.workbench").joinpath("page", "lumen.js")
    schema = resources.files("gcar_deploy.output").joinpath("result.schema.json")
    for text in (files["report.html"].decode(), page.read_text("utf-8"), schema.read_text("utf-8")):
        assert GHOST in text and "not there;" not in text
    # DICOM's limit for the meaning of a code.
    assert dicom_sr.GHOST is GHOST and len(GHOST) <= 64
