"""What is said in several places is said in the same words, and is so."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gcar_deploy.output.colors import SCALE

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
