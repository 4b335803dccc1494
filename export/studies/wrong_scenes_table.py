"""What becomes of wrong scenes, and of the right ones beside them: rows, tables, ROC."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gcar_deploy.config import QualityOptions
from gcar_deploy.engine import Engine
from gcar_deploy.errors import GcarError
from gcar_deploy.quality.status import OK, REFUSED
from gcar_deploy.result import Result
from gcar_deploy.tree.curves import points_every
from gcar_deploy.types import Points
from gcar_export.studies.wrong_scenes import PICTURES, VIEWS, Exam, Told, exam, wrong_scenes

#: a tree is off from here on, mm, after the best common shift
OFF_MM = 1.0
#: A tree that runs as near to the vessels of every mask or raw picture as that of the right scene,
#: to within so many pixels, is the proof that nobody can see the error in them
AS_NEAR_PX = 0.25
#: score of what was refused: worse than any finding
_REFUSED_SCORE = 10.0
RIGHT = "right"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """What became of one scene.

    Attributes
    ----------
    exam, pictures, views : which examination
    family, change : what is wrong; ``right`` where nothing is
    shows : see ``wrong_scenes``
    status, sentence : of the result, or of its refusal
    error_mm : Chamfer distance of the centrelines after the best common shift; None without a tree
    right_mm : the same of the right scene
    score : how far the worst check is from its line (1: at it); see ``score_of``
    gap_px, right_gap_px : per view, mean distance of the picture's skeleton from the tree, of
        this scene and of the right one; empty without a tree
    """

    exam: str
    pictures: str
    views: int
    family: str
    change: str
    shows: str
    status: str
    sentence: str
    error_mm: float | None
    right_mm: float | None
    score: float
    gap_px: tuple[float, ...] = ()
    right_gap_px: tuple[float, ...] = ()

    @property
    def explained(self) -> bool:
        """Whether a tree explains masks or raw pictures as well as the right scene's does."""
        if self.pictures == "path_length" or not self.gap_px or not self.right_gap_px:
            return False
        more = np.subtract(self.gap_px, self.right_gap_px)
        return bool(more.max() <= AS_NEAR_PX)

    @property
    def missed(self) -> bool:
        """Whether the tree is off, its rays or its lie show it, and the status says ``ok``."""
        visible = self.change != RIGHT and self.shows != "nothing"
        return visible and self.status == OK and (self.error_mm or 0.0) > OFF_MM

    @property
    def missed_plainly(self) -> bool:
        """The same where the pictures show it: no tree explains them, or it is anatomy's."""
        return self.missed and not (self.shows == "rays" and self.explained)


def measure(
    seed: int, trees: int, right: int, on_scene: Callable[[Row], None], families: Sequence[str] = ()
) -> list[Row]:
    """Reconstruct wrong scenes and right ones.

    Parameters
    ----------
    seed : of the population of generated trees
    trees : examinations that are spoilt; kinds of pictures and numbers of views take turns
    right : further examinations of each kind of pictures and number of views, not spoilt
    on_scene : told of every row
    families : of wrong scenes; all where empty
    """
    engine, rows = Engine(threads=1), []
    for case, spoilt in _exams(seed, trees, right):
        own = examined(engine, case, (RIGHT, RIGHT, "nothing"), case.told)
        wrong = wrong_scenes(case) if spoilt else ()
        scenes = [s for s in wrong if not families or s.family in families]
        rows.append(own)
        on_scene(own)
        for s in scenes:
            what = (s.family, s.name, s.shows)
            rows.append(examined(engine, case, what, s.told, own))
            on_scene(rows[-1])
    return rows


def _exams(seed: int, trees: int, right: int) -> Iterator[tuple[Exam, bool]]:
    turns = [(pictures, views) for views in VIEWS for pictures in PICTURES]
    for k in range(trees):
        yield exam(seed, k, *turns[k % len(turns)]), True
    for k in range(right * len(turns)):
        yield exam(seed, trees + k, *turns[k % len(turns)]), False


def examined(
    engine: Engine, case: Exam, what: tuple[str, str, str], told: Told, right: Row | None = None
) -> Row:
    """Reconstruct one scene, and compare it with what became of the right one."""
    error_mm, score = None, _REFUSED_SCORE
    gap_px: tuple[float, ...] = ()
    try:
        result = engine.reconstruct(list(told.images), case.scene(told))
    except GcarError as error:
        status, sentence = REFUSED, str(error)
    else:
        status, sentence = result.quality.status, "; ".join(result.quality.findings)
        error_mm = shape_error_mm(points_every(result.tree, 0.5), case.line_mm)
        score = score_of(result, case.pictures == "path_length")
        gap_px = _gaps_px(result)
    family, change, shows = what
    return Row(
        exam=case.name, pictures=case.pictures, views=len(told.carms), family=family,
        change=change, shows=shows, status=status, sentence=sentence, error_mm=error_mm,
        right_mm=error_mm if right is None else right.error_mm, score=score, gap_px=gap_px,
        right_gap_px=gap_px if right is None else right.gap_px,
    )  # fmt: skip


def _gaps_px(result: Result) -> tuple[float, ...]:
    sizes = [view.carm.pixel_at_isocenter_mm for view in result.views]
    seen = [view.distance_mm for view in result.quality.views]
    return tuple(np.inf if d is None else d / mm for d, mm in zip(seen, sizes, strict=True))


def score_of(result: Result, calibrated: bool) -> float:
    """How far the worst of the continuous checks is from its line; findings count as 1 at least."""
    gates = QualityOptions()
    good = gates.good_disagreement if calibrated else gates.sure_disagreement_raw
    ratios = [(result.quality.disagreement or 0.0) / good]
    for view in result.quality.views:
        for value, least in (
            (view.coverage, gates.good_coverage), (view.support, gates.good_support),
        ):  # fmt: skip
            ratios.append((1 - (value or 0.0)) / (1 - least))
    for pose in result.poses:
        ratios += [pose.shift_mm / gates.good_shift_mm, pose.turn_deg / gates.good_turn_deg]
    found = len(result.quality.findings)
    return max(max(ratios), 1.0) + 0.01 * found if found else min(max(ratios), 0.999)


def shape_error_mm(found: Points, truth: Points, steps: int = 30) -> float:
    """Mean of both mean distances between two lines after the best common shift, mm."""
    fixed, moved = cKDTree(truth), found
    least = np.inf
    for _ in range(steps):
        there, index = fixed.query(moved)
        back, other = cKDTree(moved).query(truth)
        least = min(least, float(0.5 * (there.mean() + back.mean())))
        steps_mm = np.concatenate([truth[index] - moved, truth - moved[other]])
        moved = moved + np.median(steps_mm, axis=0)
    return least


def write_csv(rows: Sequence[Row], file: Path) -> None:
    """Write all rows."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, [f.name for f in dataclasses.fields(Row)])
        writer.writeheader()
        writer.writerows(dataclasses.asdict(row) for row in rows)


def tables(rows: Sequence[Row]) -> str:
    """Markdown: statuses per family, scenes that were missed, right scenes, ROC of the score."""
    wrong = [row for row in rows if row.change != RIGHT]
    lines = [
        f"{len(wrong)} wrong scenes, {sum(r.missed for r in wrong)} of them `ok` although the "
        f"rays of true points miss each other or the tree's lie is wrong, and the tree is off by "
        f"more than {OFF_MM:g} mm; {sum(r.missed_plainly for r in wrong)} of them where no tree "
        f"was found that runs as near to the vessels in every picture as the right one.",
        "", "| wrong | scenes | ok / degraded / refused | ok, off, rays or lie show it "
        "| pictures too | ok, off, invisible |",
        "|---" * 6 + "|",
    ]  # fmt: skip
    for family in dict.fromkeys(row.family for row in wrong):
        own = [row for row in wrong if row.family == family]
        hidden = [r for r in own if r.status == OK and (r.error_mm or 0) > OFF_MM and not r.missed]
        missed = sum(r.missed for r in own)
        plain = sum(r.missed_plainly for r in own)
        lines.append(
            f"| {family} | {len(own)} | {_statuses(own)} | {missed} | {plain} | {len(hidden)} |"
        )
    lines += ["", "| `ok`, off | pictures | views | shows | error mm | right mm "
              "| skeleton to tree, px | of the right scene |", "|---" * 8 + "|"]  # fmt: skip
    lines += [
        f"| {r.change} | {r.pictures} | {r.views} | {r.shows} | {_mm(r.error_mm)} "
        f"| {_mm(r.right_mm)} | {_px(r.gap_px)} | {_px(r.right_gap_px)} |"
        for r in wrong if r.missed
    ]  # fmt: skip
    lines += ["", "| right scenes | views | scenes | ok / degraded / refused | ok % |",
              "|---" * 5 + "|"]  # fmt: skip
    for pictures in PICTURES:
        for views in VIEWS:
            own = [r for r in rows if (r.change, r.pictures, r.views) == (RIGHT, pictures, views)]
            if own:
                share = np.mean([r.status == OK for r in own])
                lines.append(
                    f"| {pictures} | {views} | {len(own)} | {_statuses(own)} | {share:.0%} |"
                )
    doubted = [r for r in rows if r.change == RIGHT and r.status != OK]
    if doubted:
        lines += ["", "| right, not `ok` | pictures | views | error mm | why |", "|---" * 5 + "|"]
    lines += [
        f"| {r.exam} | {r.pictures} | {r.views} | {_mm(r.error_mm)} | {r.sentence} |"
        for r in doubted
    ]
    return "\n".join([*lines, "", roc_table(rows)])


def roc_table(rows: Sequence[Row]) -> str:
    """Markdown: share of visible wrong scenes above a score, and of right scenes above it."""
    bad = np.array([
        r.score for r in rows if r.change != RIGHT and r.shows != "nothing"
        and (r.error_mm is None or r.error_mm > OFF_MM)
    ])  # fmt: skip
    good = np.array([r.score for r in rows if r.change == RIGHT])
    if not len(bad) or not len(good):
        return ""
    area = np.mean(bad[:, None] > good[None]) + 0.5 * np.mean(bad[:, None] == good[None])
    lines = [
        f"ROC of the worst check over its line, {len(bad)} visible wrong scenes against "
        f"{len(good)} right ones: area {area:.3f}.",
        "", "| score above | wrong found | right doubted |", "|---" * 3 + "|",
    ]  # fmt: skip
    lines += [
        f"| {level:g} | {np.mean(bad > level):.1%} | {np.mean(good > level):.1%} |"
        for level in (0.25, 0.5, 0.75, 0.9995, 1.5, 3.0)
    ]
    return "\n".join(lines)


def _statuses(rows: Sequence[Row]) -> str:
    return " / ".join(str(sum(r.status == s for r in rows)) for s in ("ok", "degraded", "refused"))


def _px(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values) or "-"


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
