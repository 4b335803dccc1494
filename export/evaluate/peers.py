"""Figures that others published for the common protocol, printed beside ours.

PPCAR-Net (arXiv 2610.09383) retrained its peers on ImageCAS: 75 right and 75 left test arteries,
two views, binary masks. Their cases are other cases of the same set, and which two of their stored
views the tables took is not certain: no test compares them with ours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gcar_export.evaluate.tables import MEASURES, grouped, mean_sd, summarise

NOTE = "published; other cases of the same set"
#: measures of the common protocol, in the order of the table
COLUMNS = ("dsc", "cldice", "cd_mm", "parts")
#: protocol -> method -> Dice %, clDice %, CD mm (sum of both directions), connected components
PUBLISHED: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "common-lca": {
        "3DGR-CAR": (35.1, 37.2, 5.87, 76),
        "AutoCAR": (46.9, 63.0, 6.13, 11.4),
        "DeepCA": (56.6, 71.2, 6.66, 10.0),
        "PPCAR-Net": (49.5, 61.3, 5.98, 1.05),
    },
    "common-rca": {
        "3DGR-CAR": (37.3, 39.5, 7.72, 160),
        "AutoCAR": (68.8, 79.1, 3.24, 3.4),
        "DeepCA": (63.5, 78.0, 3.78, 4.4),
        "PPCAR-Net": (66.9, 80.6, 3.16, 1.05),
    },
}


def beside_peers(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown of the common protocol, left and right artery apart; empty without such rows."""
    out = []
    for (protocol, views), group in grouped(rows, ("protocol", "views")).items():
        if protocol not in PUBLISHED or views != 2:
            continue
        heads = ["method", *(MEASURES[name].heading for name in COLUMNS)]
        out.append(f"### {protocol}: beside what others published\n")
        out.append("| " + " | ".join(heads) + " |")
        out.append("|---" * len(heads) + "|")
        for entry in summarise(group):
            cells = [mean_sd(entry[name], MEASURES[name], entry["cases"]) for name in COLUMNS]
            out.append("| " + " | ".join([f"{entry['method']} ({entry['cases']})", *cells]) + " |")
        for name, figures in PUBLISHED[protocol].items():
            cells = [f"{figure:g}" for figure in figures]
            out.append("| " + " | ".join([f"*{name}, {NOTE}*", *cells]) + " |")
        out.append("")
    return "\n".join(out)
