"""Print how well vessels are found in pictures whose vessels are known.

    python -m gcar_export.studies.segmentation_table --data DIR

``DIR`` holds ``xca_masks`` (``N.png`` with ``N_gt.png``; at its top or under ``data/``) and
``cases`` (``R_*``: raw pictures; ``C_*``: the same views as noise-free path lengths). ``--model``
once per fold of a cross-validation scores each expert-masked picture by the model that left it
out. A third table is of generated pictures, trivial to hard, a fourth of forty with a catheter,
the last of seconds per picture beside one itk-rtk pair.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import click
import cv2
import numpy as np

from gcar_deploy.config import ImagingOptions, SegmenterName
from gcar_deploy.errors import ModelError, RefusedError, UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.scene import Intensity
from gcar_deploy.imaging.angiogram import DEFAULT_FIELD_MM, Angiogram, VesselImage
from gcar_deploy.imaging.extract import extract_vessels
from gcar_deploy.imaging.net import Segmenter, load_segmenter, open_segmenter
from gcar_deploy.imaging.read import read_picture
from gcar_deploy.imaging.skeleton import skeletonize
from gcar_deploy.types import Image, Mask
from gcar_export.scenes.expert_pictures import expert_mask, fold_edges
from gcar_export.scenes.sanity_pictures import EACH, sanity_picture
from gcar_export.studies import segmentation_time
from gcar_export.studies.command import ended
from gcar_export.studies.segmentation_page import write_page

#: truth of the R_ cases: rays that cross at least this much vessel
TRUTH_MM = 0.4
#: a centreline is found where one is within so many pixels
NEAR_PX = 2
#: generated pictures with a catheter
CATHETERS = 40
#: what ``generated_score`` says of the catheter
LEFT = ("catheter left", "in paths")
#: sizes of a pixel that are claimed for a generated picture, as multiples of the true one
CLAIMED = (0.7, 1.0, 1.4)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--each", action="store_true", help="one line per expert-masked picture")
    parser.add_argument("--segmenter", choices=("classic", "net", "auto"), default="auto")
    parser.add_argument(
        "--model", type=Path, action="append",
        help="ONNX file or checkpoint, by default the shipped one; several: one per fold, in order",
    )  # fmt: skip
    parser.add_argument("--pixel-mm", type=float, help="taken for the expert-masked pictures' size")
    parser.add_argument("--page", type=Path, help="HTML file with what was found in each picture")
    chosen = parser.parse_args(arguments)
    nets = [network(path) for path in chosen.model or [None]]
    cv2.setNumThreads(1)
    pairs = sorted(find(chosen.data, "xca_masks").glob("*_gt.png"), key=_number)
    cases = find(chosen.data, "cases")
    if not pairs and not cases.is_dir():
        raise UsageError(f"{chosen.data} holds neither xca_masks/N.png with N_gt.png nor cases/")
    asked = Asked(chosen.segmenter, tuple(nets), chosen.pixel_mm)
    rows: dict[str, dict[str, float]] = {}
    seen = []
    for k, path in enumerate(pairs):
        scores, found = expert_score(path, asked.net(k, len(pairs)), asked.who, asked.pixel_mm)
        rows[path.name.removesuffix("_gt.png")] = scores
        seen.append((path, found, scores))
    if rows:
        _print_expert(rows, chosen.each, asked)
    if chosen.page:
        click.echo(write_page(seen, chosen.page))
    if len(nets) == 1:
        _print_cases(cases, nets[0], asked.who)
        _print_generated(nets[0], asked.who)
        _print_catheters(nets[0], asked.who)
        print("\nTime of one picture (median, in turns)")
        print(
            segmentation_time.table(segmentation_time.timed(nets[0], segmentation_time.rtk_pair()))
        )
    return 0


@dataclasses.dataclass(frozen=True)
class Asked:
    """Who finds vessels: a method, its network or one per fold, and the size of a pixel."""

    who: SegmenterName
    nets: tuple[Segmenter, ...]
    pixel_mm: float | None

    def net(self, index: int, count: int) -> Segmenter:
        """Network that did not see picture ``index`` of ``count``, as ``expert_pictures.folds``."""
        edges = fold_edges(count, len(self.nets))
        return self.nets[int(np.searchsorted(edges, index, side="right")) - 1]


def _number(path: Path) -> tuple[int, str]:
    return len(path.name), path.name


def find(data: Path, name: str) -> Path:
    """Return the folder ``name`` at the top of ``data`` or under ``data/``."""
    return data / name if (data / name).is_dir() else data / "data" / name


def network(path: Path | None) -> Segmenter:
    """Load the segmentation network from a file, or the one that comes along."""
    if path is not None and path.suffix == ".safetensors":
        from gcar_export.shipping.export_segmenter import checkpoint_segmenter

        return checkpoint_segmenter(path)
    if path is not None:
        return open_segmenter(path, threads=1)
    found = load_segmenter("net", 1)
    if found is None:
        raise ModelError("no segmentation network is installed")
    return found


def expert_score(
    truth_path: Path,
    net: Segmenter | None = None,
    who: SegmenterName = "auto",
    pixel_mm: float | None = None,
) -> tuple[dict[str, float], VesselImage]:
    """Score one expert-masked picture; ``who`` finds the vessels, with ``net`` where given."""
    truth = expert_mask(truth_path)
    picture = truth_path.with_name(truth_path.name.replace("_gt", ""))
    angiogram = Angiogram.without_geometry(
        picture.stem, read_picture(picture), Intensity(kind="raw"), pixel_mm
    )
    start = time.process_time()
    found = extract_vessels(angiogram, ImagingOptions(segmenter=who), net)
    seconds = time.process_time() - start
    return {**mask_scores(found.mask, found.skeleton, truth), "CPU s": seconds}, found


def mask_scores(mask: Mask, line: Mask, truth: Mask) -> dict[str, float]:
    """Dice, sensitivity, precision of the mask; clDice as in Shit et al. 2021.

    ``recall``: share of the true centreline within ``NEAR_PX`` pixels of the one found.
    """
    true_line = skeletonize(truth)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * NEAR_PX + 1, 2 * NEAR_PX + 1))
    near = cv2.dilate(line.astype(np.uint8), disc) > 0
    common = float((mask & truth).sum())
    line_precision = float((line & truth).sum()) / max(1, int(line.sum()))
    line_recall = float((true_line & mask).sum()) / max(1, int(true_line.sum()))
    return {
        "Dice": 2 * common / max(1, int(mask.sum()) + int(truth.sum())),
        "sensitivity": common / max(1, int(truth.sum())),
        "precision": common / max(1, int(mask.sum())),
        "clDice": 2 * line_precision * line_recall / max(1e-12, line_precision + line_recall),
        "recall": float((true_line & near).sum()) / max(1, int(true_line.sum())),
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


def _print_expert(rows: Mapping[str, Mapping[str, float]], each: bool, asked: Asked) -> None:
    names = list(next(iter(rows.values())))
    field = f"field taken as {DEFAULT_FIELD_MM:g} mm"
    size = field if asked.pixel_mm is None else f"pixels taken as {asked.pixel_mm:g} mm"
    folds = f", {len(asked.nets)} folds" if len(asked.nets) > 1 else ""
    print(f"Expert masks, {len(rows)} pictures{folds} (no geometry: {size})")
    print("| picture | " + " | ".join(names) + " |")
    print("|---" * (len(names) + 1) + "|")
    if each:
        for picture, scores in rows.items():
            print(_line(picture, dict(scores)))
    for label, reduce in (("mean", np.mean), ("worst", np.min)):
        reduced = {n: float(reduce([r[n] for r in rows.values()])) for n in names}
        print(_line(label, reduced))


def generated_score(
    number: int, net: Segmenter | None, who: SegmenterName = "auto", claimed: float = 1.0
) -> tuple[str, dict[str, float]]:
    """Kind and scores of a generated picture whose pixels are claimed to be so many times as large.

    ``catheter left``: share of the catheter's pixels that are in the mask; ``in paths``: that
    have a path, so that the hull may hold them.
    """
    made = sanity_picture(number)
    picture = (made.pixels.astype(np.float32), 8, "")
    pixel_mm = claimed * made.carm.pixel_at_isocenter_mm
    angiogram = Angiogram.without_geometry(str(number), picture, Intensity(kind="raw"), pixel_mm)
    try:
        found = extract_vessels(angiogram, ImagingOptions(segmenter=who), net)
    except RefusedError:
        nothing = np.zeros_like(made.mask)
        return made.kind, mask_scores(nothing, nothing, made.mask) | dict.fromkeys(LEFT, 0.0)
    areas = (found.mask, found.path_mm > 0)
    count = max(1, int(made.catheter.sum()))
    left = [float((area & made.catheter).sum()) / count for area in areas]
    scores = mask_scores(found.mask, found.skeleton, made.mask)
    return made.kind, scores | dict(zip(LEFT, left, strict=True))


def _print_generated(net: Segmenter | None, who: SegmenterName) -> None:
    rows: dict[str, list[dict[str, float]]] = {}
    for claimed in CLAIMED:
        for number in range(3 * EACH):
            kind, scores = generated_score(number, net, who, claimed)
            rows.setdefault(f"{kind}, pixels said to be {claimed:g} times as large", []).append(
                scores
            )
    names = list(next(iter(rows.values()))[0])
    print("\nGenerated pictures (mean; lowest Dice)")
    print("| pictures | " + " | ".join(names) + " | lowest Dice |")
    print("|---" * (len(names) + 2) + "|")
    for label, some in rows.items():
        means = {n: float(np.mean([r[n] for r in some])) for n in names}
        print(_line(label, means | {"lowest": min(r["Dice"] for r in some)}))


def _print_catheters(net: Segmenter | None, who: SegmenterName) -> None:
    numbers = [3 * EACH * (k // EACH) + 2 * EACH + k % EACH for k in range(CATHETERS)]
    rows = [generated_score(number, net, who)[1] for number in numbers]
    print(f"\n{CATHETERS} hard generated pictures, each with a catheter")
    print("| | " + " | ".join(rows[0]) + " |")
    print("|---" * (len(rows[0]) + 1) + "|")
    print(_line("mean", {n: float(np.mean([r[n] for r in rows])) for n in rows[0]}))
    print(_line("median", {n: float(np.median([r[n] for r in rows])) for n in rows[0]}))


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
    raise SystemExit(ended(main))
