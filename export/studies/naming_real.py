"""Names of the main vessels of the ImageCAS trees, read off their drawings by anatomy.

No expert named these trees. The rule: the ostium is the free end furthest to the right and up; the
LAD is the way that runs forward and down to the apex, the LCx the thickest way that runs back
round the left ventricle, the LM what they share; the RCA runs to the right, down, and back along
the diaphragm to where it gives off its last branches. Trees of which that cannot be said have no
names here (0075 left, a fragment; 0134 and 0595 right, single lines; 0561 right, whose beginning
is not clear; the ostium of 0134 left is missing).
"""

from __future__ import annotations

from pathlib import Path

from gcar_export.scenes.stenosis_cases import thinned_label
from gcar_export.studies.naming_cases import NamedTree

#: branches (from 1) of ``thinned_label``
LEFT: dict[str, dict[str, tuple[int, ...]]] = {
    "0001": {"LM": (8,), "LAD": (2, 3, 4, 5), "LCx": (1,)},
    "0003": {"LM": (9,), "LAD": (4, 3, 2, 1), "LCx": (5,)},
    "0401": {"LM": (19,), "LAD": (5, 6), "LCx": (4,)},
    "0491": {"LM": (18,), "LAD": (8, 17, 9), "LCx": (7, 6, 5)},
    "0561": {"LM": (11,), "LAD": (4, 5, 6), "LCx": (3, 2, 1)},
    "0595": {"LM": (5,), "LAD": (2, 3), "LCx": (1,)},
    "0640": {"LM": (11,), "LAD": (2, 4, 5), "LCx": (1,)},
}
RIGHT: dict[str, dict[str, tuple[int, ...]]] = {
    "0001": {"RCA": (1, 2)},
    "0003": {"RCA": (7, 2)},
    "0075": {"RCA": (2,)},
    "0401": {"RCA": (1, 2, 3)},
    "0491": {"RCA": (1, 2)},
    "0640": {"RCA": (1, 3)},
}


def real_cases(data: Path) -> list[tuple[str, NamedTree]]:
    """Named trees of ``data/imagecas``, each with the patient's number."""
    out = []
    for side, table in (("left", LEFT), ("right", RIGHT)):
        for patient, told in table.items():
            tree = thinned_label(data / "imagecas" / f"{patient}.label.nii.gz", side)
            names = [""] * len(tree.branches)
            for name, numbers in told.items():
                for number in numbers:
                    names[number - 1] = name
            out.append((patient, NamedTree(tree, tuple(names), "as it is")))
    return out
