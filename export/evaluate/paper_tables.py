"""Tables in the paper's own layout, with its printed figures as lines of reference.

The printed figures (3DGR-CAR, Fu et al., MICCAI 2024, Tables 1 and 2) are of other cases, and
the thresholds behind them are unpublished: they are shown beside ours and never compared by
a test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gcar_export.evaluate.tables import MEASURES, grouped, mean_sd, paired_tests, summarise

#: the four columns of the paper's tables; its projection figures are masked ones.
COLUMNS = ("new_dsc", "new_psnr_masked_db", "dsc", "ssim")
NOTE = "as printed in the paper: other cases, thresholds unpublished"
#: (dataset, printed name) -> mean and SD of each of ``COLUMNS``, in its printed unit.
PRINTED: Mapping[tuple[str, str], tuple[tuple[float, float], ...]] = {
    ("ImageCAS", "FBP"): ((33.73, 2.98), (25.07, 2.13), (31.36, 3.33), (94.81, 0.76)),
    ("ImageCAS", "NeRP"): ((33.30, 3.53), (25.34, 2.11), (30.56, 5.87), (95.99, 0.52)),
    ("ImageCAS", "3DGR-FBP"): ((52.86, 4.95), (28.90, 3.11), (63.84, 9.73), (97.15, 0.58)),
    ("ImageCAS", "3DGR-GCP, L2 alone"): (
        (52.36, 5.39), (29.81, 2.35), (63.64, 8.04), (97.90, 0.46),
    ),
    ("ImageCAS", "3DGR-GCP"): ((56.24, 4.21), (30.56, 2.41), (70.03, 5.95), (98.69, 0.41)),
    ("ASOCA", "FBP"): ((31.58, 4.24), (26.06, 4.35), (40.06, 4.24), (95.71, 1.18)),
    ("ASOCA", "NeRP"): ((31.96, 4.25), (26.21, 4.20), (29.50, 7.28), (97.66, 0.72)),
    ("ASOCA", "3DGR-GCP"): ((59.79, 5.93), (30.32, 4.43), (73.06, 6.26), (97.96, 0.61)),
}  # fmt: skip
#: rows of each of the paper's tables: our method -> the paper's name for it, or None.
TABLE_1: Mapping[str, str | None] = {
    "fdk": "FBP", "sart": None, "visual_hull": None, "nerp": "NeRP", "3dgr-gcp": "3DGR-GCP",
    "ours": None,
}  # fmt: skip
TABLE_2: Mapping[str, str | None] = {
    "3dgr-fbp": "3DGR-FBP", "3dgr-fbp-l2": None, "3dgr-gcp-l2": "3DGR-GCP, L2 alone",
    "3dgr-gcp": "3DGR-GCP", "3dgr-gcp-short": None, "3dgr-true-depth": None, "ours": None,
}  # fmt: skip


#: what the rows are called in these tables
NAMES: Mapping[str, str] = {
    "fdk": "FBP (FDK)", "nerp": "NeRP, fitted on hull voxels", "ours": "gcar as it comes",
    "3dgr-gcp": "3DGR-GCP (as printed)", "3dgr-gcp-l2": "3DGR-GCP (as printed), L2 alone",
    "3dgr-fbp": "3DGR-FBP (as printed)", "3dgr-fbp-l2": "3DGR-FBP (as printed), L2 alone",
    "3dgr-gcp-short": "3DGR-GCP, short budget", "3dgr-true-depth": "3DGR from true depth",
}  # fmt: skip


def layout(rows: Sequence[Mapping[str, Any]], reference: str) -> str:
    """Markdown of the paper's Tables 1 and 2 for what ``rows`` hold of them.

    Datasets stand apart, as in the paper; stars are paired Wilcoxon tests within one dataset
    against ``reference``. Empty where no row belongs to the paper's set-up with two views.
    """
    chosen = [row for row in rows if row["protocol"] == "paper" and row["views"] == 2]
    parts = []
    for title, table in (("Table 1", TABLE_1), ("Table 2 (ablation)", TABLE_2)):
        present = {row["method"] for row in chosen} & set(table)
        if len(present) > 1:
            parts.append(_table(title, table, chosen, reference))
    return "\n".join(parts)


def _table(
    title: str, table: Mapping[str, str | None], rows: Sequence[Mapping[str, Any]], reference: str
) -> str:
    heads = ["dataset", "method", *(MEASURES[name].heading for name in COLUMNS)]
    out = [f"### {title} of the paper, its layout\n", "| " + " | ".join(heads) + " |"]
    out.append("|---" * len(heads) + "|")
    for (dataset,), group in grouped(rows, ("dataset",)).items():
        stars = {(t["method"], t["measure"]): t["stars"] for t in paired_tests(group, reference)}
        found = {entry["method"]: entry for entry in summarise(group)}
        for method, printed in table.items():
            if method in found:
                entry = found[method]
                name = f"{dataset} ({entry['cases']})"
                cells = [
                    mean_sd(entry[c], MEASURES[c], entry["cases"]) + stars.get((method, c), "")
                    for c in COLUMNS
                ]
                out.append("| " + " | ".join([name, NAMES.get(method, method), *cells]) + " |")
            if method in found and printed is not None and (dataset, printed) in PRINTED:
                cells = [f"{m:.2f} ± {s:.2f}" for m, s in PRINTED[dataset, printed]]
                out.append("| " + " | ".join([dataset, f"*{printed}, {NOTE}*", *cells]) + " |")
    return "\n".join([*out, ""])
