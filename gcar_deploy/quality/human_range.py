"""Whether a tree has the size of a human coronary tree.

Left main arteries measure 4.5 +- 0.5 mm, proximal LAD and RCA 3.7 +- 0.4 and 3.9 +- 0.6 mm (Dodge
et al., Circulation 86:232-246, 1992); aneurysms from 8 mm on are called giant. The heart they lie
on is some 12 cm long.
"""

from __future__ import annotations

import numpy as np

from gcar_deploy.tree.tree import Tree

#: widest twentieth of the length, diameter in mm
_WIDEST_MM = (0.8, 8.0)
#: largest side of the box round the tree, mm
_LARGEST_MM = 220.0
#: shorter trees are parts, which say nothing of a whole one
_WHOLE_MM = 60.0


def check_human_range(tree: Tree) -> list[str]:
    """Return findings where calibre or extent are outside what human coronary arteries have."""
    if tree.length_mm < _WHOLE_MM:
        return []
    weight = np.concatenate([np.gradient(branch.arc_mm) for branch in tree.branches])
    diameter = 2 * tree.radii()
    order = np.argsort(diameter)
    reached = np.cumsum(weight[order]) >= 0.95 * weight.sum()
    widest = float(diameter[order][np.argmax(reached)])
    extent = float(np.ptp(tree.points(), axis=0).max())
    findings = []
    low, high = _WIDEST_MM
    if not low <= widest <= high:
        findings.append(
            f"the widest vessels measure {widest:.1f} mm ({low:g} to {high:g} mm are usual): "
            "are pixel spacing and distances right?"
        )
    if extent > _LARGEST_MM:
        findings.append(
            f"the tree extends over {extent:.0f} mm (up to {_LARGEST_MM:g} mm is usual): "
            "are pixel spacing and distances right?"
        )
    return findings
