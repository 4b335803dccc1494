"""Speed against error of gcar's settings and of the peers, all timed in one run.

Round after round every setting is run once on each case, warm, with an itk-rtk projection pair of
the same size beside it: on a machine that others use, each meets the same. What counts is the
multiple of the pair; seconds are those of this machine at this hour.
"""

from __future__ import annotations

import dataclasses
import itertools
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gcar_deploy.measure.metrics import chamfer_mm, skeleton, volume_dice
from gcar_deploy.types import Volume
from gcar_export.evaluate.plots import MARKERS, figure
from gcar_export.methods.nerp import NerpOptions
from gcar_export.methods.rtk_timing import pair_clock
from gcar_export.methods.settings import MethodSettings
from gcar_export.methods.solve import Solved, solve
from gcar_export.scenes.protocols import Case

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: steps of the implicit network, which needs some 400 to end: a bound of its time from below
NERP_STEPS = 40
#: the setting that is the runtime's own
OURS = "multi + tube, 2 lattices"


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is run: a row of the methods, and with which options."""

    method: str
    options: MethodSettings = dataclasses.field(default_factory=MethodSettings)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One setting over all cases.

    Attributes
    ----------
    setting : str
    pairs : median over cases and rounds, seconds over those of the itk-rtk pair timed beside it
    seconds, cpu_seconds : medians likewise; the second of all threads
    dsc : mean volume DSC at 0.5, 0 .. 1; of a case without a volume 0
    chamfer_mm : mean over the cases that have one; None without any
    unsolved : cases that gave no volume
    front : nothing is both faster and better by DSC
    stages : stage -> median seconds; of gcar's settings alone
    """

    setting: str
    pairs: float
    seconds: float
    cpu_seconds: float
    dsc: float
    chamfer_mm: float | None
    unsolved: int
    front: bool
    stages: Mapping[str, float]


def settings() -> dict[str, Setting]:
    """Return gcar over predictor, refiner and lattices, and the peers."""
    out = {}
    for lattices in (1, 2):
        plain = MethodSettings()
        predict = dataclasses.replace(plain.run.predict, lattices=lattices)
        asked = dataclasses.replace(plain, run=dataclasses.replace(plain.run, predict=predict))
        name = f"{lattices} {'lattice' if lattices == 1 else 'lattices'}"
        out[f"multi alone, {name}"] = Setting("multi", asked)
        out[f"multi + tube, {name}"] = Setting("multi+tube", asked)
        out[f"multi + paper, {name}"] = Setting("multi+paper", asked)
    out |= {
        "hull alone": Setting("hull"),
        "hull + tube": Setting("hull+tube"),
        "hull + paper": Setting("hull+paper"),
        "FDK": Setting("fdk"),
        "SART": Setting("sart"),
        "visual hull": Setting("visual_hull"),
        f"NeRP, {NERP_STEPS} steps": Setting(
            "nerp", MethodSettings(nerp=NerpOptions(steps=NERP_STEPS))
        ),
    }
    return out


def rows(
    cases: Sequence[Case],
    asked: Mapping[str, Setting],
    rounds: int,
    on_run: Callable[[], None] | None = None,
    solver: Callable[[Case, str, MethodSettings], Solved] = solve,
) -> list[Row]:
    """Run every setting on every case, ``rounds`` times; ``solve`` has warmed up when it times.

    Parameters
    ----------
    cases : Case
    asked : name -> Setting
    rounds : int
    on_run : called after each run
    solver : what makes a volume of a case
    """
    times: dict[str, list[tuple[float, Solved]]] = {name: [] for name in asked}
    errors: dict[str, list[tuple[float, float | None]]] = {name: [] for name in asked}
    for case in cases:
        pair = pair_clock(case.truth, case.grid, case.scene_carms)
        for round_ in range(rounds):
            for name, one in asked.items():
                solved = solver(case, one.method, one.options)
                times[name].append((solved.seconds["total"] / pair(), solved))
                if not round_:
                    errors[name].append(_errors(case, solved.volume))
                if on_run is not None:
                    on_run()
    made = [_row(name, times[name], errors[name]) for name in asked]
    best = {row.setting for row in front(made)}
    return [dataclasses.replace(row, front=row.setting in best) for row in made]


def front(made: Sequence[Row]) -> Iterator[Row]:
    """Yield the rows than which none is both faster and better, the fastest first."""
    best = -1.0
    for row in sorted(made, key=lambda r: (r.pairs, -r.dsc)):
        if row.dsc > best:
            best = row.dsc
            yield row


def table(made: Sequence[Row]) -> str:
    """Markdown, the fastest first, and the stages of the runtime's own setting below."""
    lines = [
        "| setting | pairs | s | CPU s | DSC(0.5) % | Chamfer mm | no volume | front |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in sorted(made, key=lambda r: r.pairs):
        apart = "-" if row.chamfer_mm is None else f"{row.chamfer_mm:.2f}"
        lines.append(
            f"| {row.setting} | {row.pairs:.1f} | {row.seconds:.2f} | {row.cpu_seconds:.2f} | "
            f"{100 * row.dsc:.1f} | {apart} | {row.unsolved} | {'*' if row.front else ''} |"
        )
    for row in made:
        if row.setting == OURS:
            stages = ", ".join(f"{name} {s:.3f}" for name, s in row.stages.items())
            lines.append(f"\nstages of {OURS}, s: {stages}")
    return "\n".join(lines)


def picture(made: Sequence[Row]) -> Figure:
    """Pairs (log) against DSC, the front joined."""
    fig = figure(7.6, 4.8)
    axis = fig.subplots()
    best = list(front(made))
    axis.plot([r.pairs for r in best], [100 * r.dsc for r in best], color="#444444", lw=1)
    for row, marker in zip(made, itertools.cycle(MARKERS), strict=False):
        label = f"{row.setting}: {row.pairs:.1f}"
        axis.plot(row.pairs, 100 * row.dsc, marker, ms=7, mec="black", mew=0.6, label=label)
    axis.set_xscale("log")
    axis.set_xlabel("itk-rtk forward + back projection pairs")
    axis.set_ylabel("volume DSC(0.5), %")
    axis.grid(which="both", alpha=0.2)
    axis.set_title("Speed against error in one run; line: Pareto front")
    fig.legend(loc="outside right center", frameon=False)
    return fig


def values(made: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows as plain values."""
    return [dataclasses.asdict(row) for row in made]


def _errors(case: Case, volume: Volume | None) -> tuple[float, float | None]:
    """DSC and Chamfer distance at 0.5."""
    if volume is None:
        return 0.0, None
    spacing = case.grid.spacing_mm
    lines = (skeleton(v >= 0.5, spacing) for v in (case.truth, volume))
    return volume_dice(case.truth, volume).value or 0.0, chamfer_mm(*lines).value


def _row(
    name: str, timed: Sequence[tuple[float, Solved]], errors: Sequence[tuple[float, float | None]]
) -> Row:
    runs = [solved.seconds for _, solved in timed]
    apart = [far for _, far in errors if far is not None]
    stages = set.intersection(*(set(run) for run in runs)) - {"total", "cpu"}
    return Row(
        setting=name,
        pairs=statistics.median(pairs for pairs, _ in timed),
        seconds=statistics.median(run["total"] for run in runs),
        cpu_seconds=statistics.median(run["cpu"] for run in runs),
        dsc=statistics.fmean(dsc for dsc, _ in errors),
        chamfer_mm=statistics.fmean(apart) if apart else None,
        unsolved=sum(solved.volume is None for _, solved in timed) // (len(timed) // len(errors)),
        front=False,
        stages={k: statistics.median(r[k] for r in runs) for k in runs[0] if k in stages},
    )
