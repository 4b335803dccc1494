"""Plots of an evaluation: bars over views as in the paper's figures, speed against error.

Matplotlib's objects are used without pyplot: no global state, no display.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_export.evaluate.tables import MEASURES, grouped, paired_tests, summarise
from gcar_export.methods.settings import METHODS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: one colour per method: dark and light of one hue for neighbours in the list of methods.
COLOURS = (
    "#1f77b4", "#aec7e8", "#4b5fa0", "#8fa3d9", "#ff7f0e", "#ffbb78", "#d62728", "#98df8a",
    "#2ca02c", "#7f9f3f", "#005f2f", "#e377c2", "#f7b6d2", "#9467bd", "#8c564b", "#444444",
    "#999999", "#bcbd22", "#17becf",
)  # fmt: skip
MARKERS = "osD^vPXdph<>"
#: title -> (measure of the bars, measure of the lines), as in the paper's two figures.
FIGURES: Mapping[str, tuple[str, str]] = {
    "New projections": ("new_dsc", "new_psnr_masked_db"),
    "Volume": ("dsc", "ssim"),
}
Rows = Sequence[Mapping[str, Any]]


def figure(width_in: float, height_in: float) -> Figure:
    """Return an empty matplotlib figure that knows how to save itself.

    Raises
    ------
    UsageError
        Matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError("plots need matplotlib: pip install 'gcar[export]'") from None
    out = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(out)
    return out


def style(method: str) -> tuple[str, str]:
    """Colour and marker of a method, the same in every picture."""
    k = METHODS.index(method) if method in METHODS else len(METHODS)
    return COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]


def bars_over_views(rows: Rows, reference: str) -> Figure:
    """Bars for DSC and lines for PSNR and SSIM by number of views; one protocol.

    Stars over a bar: paired Wilcoxon test of ``reference`` against that method.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    views = sorted({row["views"] for row in rows})
    fig = figure(max(7.0, 1.4 + 0.34 * len(methods) * len(views)), 7.6)
    axes = fig.subplots(2, 1, sharex=True)
    means = {(e["method"], e["views"]): e for e in summarise(rows)}
    stars = {(t["method"], t["views"], t["measure"]): t["stars"]
             for t in paired_tests(rows, reference)}  # fmt: skip
    for axis, (title, (bar, line)) in zip(axes, FIGURES.items(), strict=True):
        other = axis.twinx()
        for k, method in enumerate(methods):
            colour, marker = style(method)
            entries = [means.get((method, n)) for n in views]
            at = np.arange(len(views)) + 0.8 * ((k + 0.5) / len(methods) - 0.5)
            label = method + _fewer(rows, method)
            _bars(axis, at, entries, bar, colour, 0.75 / len(methods), label)
            _stars(axis, at, entries, bar, [stars.get((method, n, bar), "") for n in views])
            shown = [_figure_of(e, line)[0] for e in entries]
            other.plot(
                at, shown, marker=marker, ms=5, lw=1, alpha=0.9, color=colour, mec="black",
                mew=0.6,
            )  # fmt: skip
        axis.set_title(f"{title}: bars {MEASURES[bar].heading}, lines {MEASURES[line].heading}")
        axis.set_ylabel(MEASURES[bar].heading)
        axis.set_ylim(0, 118)
        axis.set_yticks(range(0, 101, 20))
        other.set_ylabel(MEASURES[line].heading)
        axis.set_xticks(np.arange(len(views)), [f"{n} views" for n in views])
        axis.grid(axis="y", alpha=0.25)
    fig.suptitle(f"{rows[0]['protocol']} protocol, {_cases(rows)}, mean ± SD")
    fig.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center",
        ncols=min(len(methods), int(fig.get_figwidth() / 1.6)), frameon=False,
    )  # fmt: skip
    return fig


def speed_and_error(rows: Rows) -> Figure:
    """CPU seconds per case (log) against volume DSC of all methods; one protocol and views.

    Filled: DSC at 0.5. Hollow: at the best threshold, joined to it; alone where no voxel
    reaches 0.5.
    """
    fig = figure(8.6, 5.2)
    axis = fig.subplots()
    handles = []
    timed = [entry for entry in summarise(rows) if entry["cpu_seconds"]["mean"] is not None]
    for entry in sorted(timed, key=_time_of):
        colour, marker = style(entry["method"])
        seconds, spread = _time_of(entry), entry["cpu_seconds"]["sd"] or 0.0
        (at_half, sd), (best, _) = _figure_of(entry, "dsc"), _figure_of(entry, "best_dsc")
        axis.plot([seconds] * 2, [at_half, best], color=colour, lw=1)
        axis.plot(seconds, best, marker, mfc="white", mec=colour, ms=8)
        axis.errorbar(
            seconds, at_half, yerr=sd, xerr=[[min(spread, 0.6 * seconds)], [spread]],
            fmt=marker, color=colour, ms=8, mec="black", mew=0.6, capsize=2, lw=0.8,
        )  # fmt: skip
        method = entry["method"] + _fewer(rows, entry["method"])
        label = f"{method}: {seconds:.2g} s" + (
            "" if np.isfinite(at_half) else ", no voxel reaches 0.5"
        )
        handles += axis.plot([], [], marker, color=colour, mec="black", mew=0.6, label=label)
    axis.set_xscale("log")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.set_ylim(0, 100)
    axis.set_xlabel("CPU time per case, s (all threads)")
    axis.set_ylabel("volume DSC, %")
    axis.grid(which="both", alpha=0.2)
    first = rows[0]
    axis.set_title(
        f"{first['protocol']} protocol, {first['views']} views, {_cases(rows)}, mean ± SD\n"
        "filled: DSC at 0.5; hollow: at the best threshold"
    )
    fig.legend(handles=handles, loc="outside right center", frameon=False)
    return fig


def all_figures(rows: Rows, reference: str) -> dict[str, Figure]:
    """Return file stem -> figure for every protocol in ``rows``."""
    out = {}
    for (protocol,), group in grouped(rows, ("protocol",)).items():
        out[f"bars-{protocol}"] = bars_over_views(group, reference)
        for (views,), part in grouped(group, ("views",)).items():
            out[f"speed-{protocol}-{views}"] = speed_and_error(part)
    return out


def _time_of(entry: Mapping[str, Any]) -> float:
    """Mean CPU seconds; a clock cannot show less than a hundredth on a logarithmic axis."""
    return max(float(entry["cpu_seconds"]["mean"]), 0.01)


def _cases(rows: Rows) -> str:
    count = len({row["case"] for row in rows})
    return "1 case" if count == 1 else f"{count} cases"


def _fewer(rows: Rows, method: str) -> str:
    """How many cases a method has, where not all."""
    cases = {row["case"] for row in rows}
    own = {row["case"] for row in rows if row["method"] == method}
    return "" if own == cases else f" (n={len(own)})"


def _bars(
    axis: Axes,
    at: np.ndarray,
    entries: Sequence[Any],
    name: str,
    colour: str,
    width: float,
    label: str,
) -> None:
    mean, sd = np.array([_figure_of(entry, name) for entry in entries]).T
    axis.bar(
        at, mean, width, yerr=np.nan_to_num(sd), color=colour, alpha=0.75, label=label,
        error_kw={"lw": 0.8, "capsize": 1.5},
    )  # fmt: skip


def _stars(
    axis: Axes, at: np.ndarray, entries: Sequence[Any], name: str, stars: Sequence[str]
) -> None:
    for x, entry, text in zip(at, entries, stars, strict=True):
        mean, sd = _figure_of(entry, name)
        if text and np.isfinite(mean):
            top = mean + np.nan_to_num(sd) + 0.5
            axis.text(x, top, text, ha="center", va="bottom", fontsize=7, rotation=90)


def _figure_of(entry: Mapping[str, Any] | None, name: str) -> tuple[float, float]:
    """Mean and SD in the measure's own unit; NaN where there is none."""
    factor = MEASURES[name].factor
    values = (None, None) if entry is None else (entry[name]["mean"], entry[name]["sd"])
    mean, sd = (np.nan if value is None else value * factor for value in values)
    return mean, sd
