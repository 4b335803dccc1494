"""Names to fit to: true ones of generated trees, and a fit that tells readings apart."""

from __future__ import annotations

import numpy as np
import pytest

from gcar_deploy.measure.naming import Reading, probabilities, read_anatomy, readings
from gcar_export.studies.naming_cases import NamedTree, components, named_case, right_reading
from gcar_export.studies.naming_fit import FIGURES, Example, as_json, fit, table, tally
from tests.measure.test_naming import left_tree

TRUE = ("LM", "LAD", "LCx", "LAD", "")


def case(names=TRUE):
    return NamedTree(left_tree(), names, "as it is")


def test_the_right_reading_is_the_one_that_names_most():
    found = readings(left_tree(), np.arange(5))
    right, clear = right_reading(case(), found)
    assert clear and found[right].names == {0: "LM", 1: "LAD", 3: "LAD", 2: "LCx"}
    assert right_reading(case(("",) * 5), found) == (None, True)


def test_generated_trees_know_their_names_and_mirrored_ones_have_none():
    made = named_case(30_000_001, "as it is", "left")
    assert {"LM", "LAD", "LCx"} <= set(made.names)
    assert sorted(np.concatenate(components(made.tree))) == list(range(len(made.tree.branches)))
    assert set(named_case(30_000_001, "mirrored", "left").names) == {""}


def some_examples(count, rng):
    """Right readings lie round 0, the others 1.5 away; every third component has none."""
    out = []
    for k in range(count):
        side = k % 2
        size = len(FIGURES[("left", "right")[side]])
        right = -1 if k % 3 == 0 else int(rng.integers(4))
        figures = [rng.normal(0.0 if j == right else 1.5, 0.4, size) for j in range(4)]
        out.append(Example(np.full(4, side), figures, right))
    return out


def test_the_fit_tells_right_readings_from_others():
    rng = np.random.default_rng(0)
    usual = fit(some_examples(60, rng))
    for side, template in usual.items():
        np.testing.assert_allclose(template.mean, 0.0, atol=0.35)
        assert (template.weight >= 0).all() and len(template.weight) == len(FIGURES[side])
    for example in some_examples(30, rng):
        side = ("left", "right")[example.side[0]]
        share = probabilities([Reading(side, {}, f, 0) for f in example.figures], usual)
        if example.right < 0:
            assert share.sum() < 0.2
        else:
            assert share[example.right] > 0.8
    assert '"made_of": "this"' in as_json(usual, "this")


def test_tally_counts_branches_and_their_length():
    wrong = tuple("RCA" if name == "LCx" else name for name in TRUE)
    counts = tally((c, None) for c in (case(), case(wrong)))
    assert counts["LAD"][:3] == [4, 4, 0] and counts["RCA"][:3] == [1, 0, 1]
    assert counts["none"][:3] == [2, 0, 0]
    lcx = left_tree().branches[2].length_mm
    assert counts["RCA"][3:] == pytest.approx([lcx, 0.0, lcx])
    assert f"| RCA | 1 | 0 | 1 | {lcx:.0f} | 0 | {lcx:.0f} |" in table("made", counts)
    assert [n and n.name for n in read_anatomy(left_tree()).names] == [n or None for n in TRUE]
