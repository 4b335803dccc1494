"""Print how well vessels are found in pictures whose vessels are known.

    python -m gcar_export.studies.segmentation_table --data DIR

``DIR`` holds ``xca_masks`` (``N.png`` with ``N_gt.png``; at its top or under ``data/``) and
``cases`` (``R_*``: raw pictures; ``C_*``: the same views as noise-free path lengths).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gcar_deploy.config import ImagingOptions, SegmenterName
from gcar_deploy.errors import ModelError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import DEFAULT_FIELD_MM, Angiogram, VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.net import Segmenter, load_segmenter, open_segmenter
from gcar_deploy.imaging.read import read_picture
from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.types import Image, Mask

#: truth of the R_ cases: rays that cross at least this much vessel
TRUTH_MM = 0.4


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--each", action="store_true", help="one line per expert-masked picture")
    parser.add_argument("--segmenter", choices=("classic", "net", "auto"), default="auto")
    parser.add_argument("--model", type=Path, help="ONNX file for net; by default the shipped one")
    chosen = parser.parse_args(arguments)
    net = None if chosen.segmenter == "classic" else network(chosen.model)
    who = chosen.segmenter
    cv2.setNumThreads(1)
    pairs = sorted(find(chosen.data, "xca_masks").glob("*_gt.png"))
    if pairs:
        _print_expert(pairs, chosen.each, net, who)
    _print_cases(find(chosen.data, "cases"), net, who)
    return 0


def find(data: Path, name: str) -> Path:
    """Return the folder ``name`` at the top of ``data`` or under ``data/``."""
    return data / name if (data / name).is_dir() else data / "data" / name


def network(path: Path | None) -> Segmenter:
    """Load the segmentation network from a file, or the one that comes along."""
    if path is not None:
        return open_segmenter(path, threads=1)
    found = load_segmenter("net", 1)
    if found is None:
        raise ModelError("no segmentation network is installed")
    return found


def expert_score(
    truth_path: Path, net: Segmenter | None = None, who: SegmenterName = "auto"
) -> tuple[dict[str, float], VesselImage]:
    """Score one expert-masked picture; ``who`` finds the vessels, with ``net`` where given."""
    truth = read_picture(truth_path)[0] > 127
    picture = truth_path.with_name(truth_path.name.replace("_gt", ""))
    angiogram = Angiogram.without_geometry(
        picture.stem, read_picture(picture), Intensity(kind="raw")
    )
    start = time.process_time()
    found = extract_vessels(angiogram, ImagingOptions(segmenter=who), net)
    seconds = time.process_time() - start
    return {**mask_scores(found.mask, found.skeleton, truth), "CPU s": seconds}, found


def mask_scores(mask: Mask, line: Mask, truth: Mask) -> dict[str, float]:
    """Dice, sensitivity, precision of the mask; clDice as in Shit et al. 2021."""
    true_line = skeletonize(truth)
    common = float((mask & truth).sum())
    line_precision = float((line & truth).sum()) / max(1, int(line.sum()))
    line_recall = float((true_line & mask).sum()) / max(1, int(true_line.sum()))
    return {
        "Dice": 2 * common / max(1, int(mask.sum()) + int(truth.sum())),
        "sensitivity": common / max(1, int(truth.sum())),
        "precision": common / max(1, int(mask.sum())),
        "clDice": 2 * line_precision * line_recall / max(1e-12, line_precision + line_recall),
    }


def case_scores(
    cases: Path, net: Segmenter | None = None, who: SegmenterName = "auto"
) -> Iterator[tuple[str, dict[str, float], VesselImage, Image]]:
    """Score each view of each ``R_*`` case against the path lengths of its ``C_*`` case."""
    for raw in sorted(cases.glob("R_*")):
        clean = raw.with_name("C_" + raw.name[2:])
        scene, true_scene = (json.loads((p / "geom.json").read_text()) for p in (raw, clean))
        views = zip(scene["views"], true_scene["views"], strict=True)
        for number, (view, true_view) in enumerate(views, start=1):
            truth = read_picture(clean / f"view{number}.png")[0]
            truth *= true_view["intensity"]["mm_per_count"]
            pixels, depth, sha256 = read_picture(raw / f"view{number}.png")
            intensity = Intensity(**view.pop("intensity"))
            view.pop("id", None)
            angiogram = Angiogram(
                view_id=str(number), carm=CArm(**view), pixels=pixels, bit_depth=depth,
                intensity=intensity, sha256=sha256,
            )  # fmt: skip
            start = time.process_time()
            found = extract_vessels(angiogram, ImagingOptions(segmenter=who), net)
            seconds = time.process_time() - start
            scores = mask_scores(found.mask, found.skeleton, truth >= TRUTH_MM)
            scores |= path_scores(found.path_mm, truth) | {"CPU s": seconds}
            yield f"{raw.name} view {number}", scores, found, truth


def path_scores(path_mm: Image, truth_mm: Image) -> dict[str, float]:
    """Pearson correlation over the union of both, and estimated over true total path."""
    either = (path_mm > 0) | (truth_mm > 0)
    both = (path_mm > 0) & (truth_mm > TRUTH_MM)
    return {
        "correlation": float(np.corrcoef(path_mm[either], truth_mm[either])[0, 1]),
        "scale": float(np.median(path_mm[both] / truth_mm[both])),
        "mass": float(path_mm.sum() / truth_mm.sum()),
    }


def _print_expert(
    pairs: Sequence[Path], each: bool, net: Segmenter | None, who: SegmenterName
) -> None:
    rows = {path.name.replace("_gt.png", ""): expert_score(path, net, who)[0] for path in pairs}
    names = list(next(iter(rows.values())))
    print(
        f"Expert masks, {len(rows)} pictures (no geometry: field taken as {DEFAULT_FIELD_MM:g} mm)"
    )
    print("| picture | " + " | ".join(names) + " |")
    print("|---" * (len(names) + 1) + "|")
    if each:
        for picture, scores in rows.items():
            print(_line(picture, scores))
    halves: dict[str, tuple[Callable[[list[float]], Any], dict[str, dict[str, float]]]] = {
        "mean": (np.mean, rows),
        "mean, odd numbers (options were chosen with them)": (np.mean, _numbered(rows, 1)),
        "mean, even numbers": (np.mean, _numbered(rows, 0)),
        "worst": (np.min, rows),
    }
    for label, (reduce, some) in halves.items():
        if some:
            print(_line(label, {n: float(reduce([r[n] for r in some.values()])) for n in names}))


def _numbered(rows: dict[str, dict[str, float]], rest: int) -> dict[str, dict[str, float]]:
    """Pictures whose name is a number with this remainder after division by two."""
    return {name: r for name, r in rows.items() if name.isdigit() and int(name) % 2 == rest}


def _print_cases(cases: Path, net: Segmenter | None, who: SegmenterName) -> None:
    heading = True
    for name, scores, _, _ in case_scores(cases, net, who):
        if heading:
            print(f"\nRaw pictures of simulated views (truth: path >= {TRUTH_MM} mm)")
            print("| view | " + " | ".join(scores) + " |")
            print("|---" * (len(scores) + 1) + "|")
            heading = False
        print(_line(name, scores))


def _line(label: str, scores: dict[str, float]) -> str:
    return f"| {label} | " + " | ".join(f"{value:.3f}" for value in scores.values()) + " |"


if __name__ == "__main__":
    raise SystemExit(main())
