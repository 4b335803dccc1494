"""Diameters as quantitative coronary analysis takes them: profiles across each vessel, every view.

The tubes say where the vessels run. Every ``STEP_MM`` along each branch each view's own pixels are
read on a line across the projected axis, and an elliptical lumen behind the view's blur is fitted
(``measure.profile``). Where paths are calibrated its area is that of the densitogram, whatever the
blur; elsewhere edges and contrast share it, the scale of the contrast and the blur being those of
the clearest sections of the same picture. The views' areas are then joined along the branch.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from scipy.linalg import solveh_banded

from gcar_deploy.beside import side_by_side
from gcar_deploy.measure.overlaps import Course, hidden_samples, within_others
from gcar_deploy.measure.profile import DEPTH, GROUND, HALF, Belief, Fitted, Profiles, fit_profiles
from gcar_deploy.measure.signals import Signal
from gcar_deploy.measure.silhouette import covered
from gcar_deploy.tree.tree import Branch, Tree, along
from gcar_deploy.types import Array, Points, Scalars

#: residuals so many times the noise are misfit
_NOISES = 2.0
#: sections along a branch, and the reach over which its direction is taken, mm
STEP_MM, DIRECTION_MM = 0.4, 1.5
#: samples of a profile, which reaches so many radii and so many mm to either side
SAMPLES, REACH_RADII, REACH_MM = 25, 1.6, 1.2
#: blur while it is not yet known, mm
USUAL_BLUR_MM = 0.2
#: noise is no less than this share of a vessel's contrast
LEAST_NOISE = 0.004
#: blur that is tried, standard deviation in mm, and how many sections judge it
BLURS_MM = (0.08, 0.15, 0.23, 0.33, 0.48)
JUDGES = 64
#: standard deviations beforehand: middle, mm; log half-width; log of depth over width
MIDDLE_SD, HALF_SD, OVAL_SD = 0.4, 0.5, 0.25
#: ... of the contrast from place to place, and while its scale is unknown
CONTRAST_SD, UNKNOWN_SD = 0.15, 1.0
#: the contrast is smooth along a branch over so much, mm
CONTRAST_MM = 8.0
#: error of a mask's edges, both together, pixels
MASK_EDGE_PX = 0.3
#: background of calibrated paths: standard deviation, mm
GROUND_MM = 0.03
#: error of a log radius that no pixel shows: lumens are no ellipses, axes bend
MODEL_SD = 0.03
#: neighbouring sections read the same pixels: so many count as one; anatomy behind the vessels of
#: grey pictures makes far more of them err together
CORRELATED, CORRELATED_GREY = 2.0, 16.0
#: error of the vessel's direction, which the path along a slanting ray magnifies, rad
TILT_SD = 0.07
#: overlapped: this share of the lumen lies in another vessel's shadow; a profile is clear where
#: the ray leaves the vessel at a sine above this as well
OVERLAP_SHARE, CLEAR_SINE = 0.3, 0.85
#: error of a log radius that one view alone shows: another vessel, or an axis that is off, would
#: not be noticed
ALONE_SD = 0.1
#: sections where no view knows the log radius better than this are not measured
UNKNOWN_SD_LOG = 0.25
#: walk of the log radius along a vessel: scale, 1 / sqrt(mm), Student's degrees of freedom
WALK, FREEDOM = 0.2, 3.0
#: the tubes' own radius counts for so little
TUBE_SD = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Sections:
    """Cross-sections along one branch.

    Attributes
    ----------
    arc_mm : (m,) distance from the branch's first point
    diameter_mm : (m,) of the circle of the same area
    sigma_mm : (m,) its standard deviation
    measured : (m,) whether a view shows it; else it is what lies between those that are
    width_mm : (views, m) extent across each view's ray; NaN where it is not seen
    overlapped : (views, m) stretches that count little or not
    """

    arc_mm: Scalars
    diameter_mm: Scalars
    sigma_mm: Scalars
    measured: Array
    width_mm: Array
    overlapped: Array


@dataclasses.dataclass(frozen=True, eq=False)
class _Places:
    """Sections of all branches in a row."""

    points_mm: Points
    tangents: Points
    radius_mm: Scalars
    branch: Array
    arc_mm: Scalars


@dataclasses.dataclass(frozen=True, eq=False)
class _Seen:
    """What one view says of every section, (n,); ``shared``: factor on sigma of what they share."""

    log_radius: Scalars
    sd: Scalars
    width_mm: Scalars
    sine: Scalars
    overlapped: Array
    shared: float
    outline: bool


def measure_sections(tree: Tree, signals: Sequence[Signal]) -> tuple[Sections, ...]:
    """Measure the cross-sections of every branch.

    Parameters
    ----------
    tree : Tree, mm LPS
    signals : of each view (``measure.signals``)
    """
    if not tree.branches:
        return ()
    places = _places(tree)
    joined = within_others(places.points_mm, places.radius_mm, places.branch)
    seen = side_by_side([functools.partial(_seen, places, signal) for signal in signals])
    seen = [dataclasses.replace(v, sd=np.where(joined, np.maximum(v.sd, 1.0), v.sd)) for v in seen]
    out = []
    for k in range(len(tree.branches)):
        own = np.flatnonzero(places.branch == k)
        out.append(_joined(places, own, seen))
    return tuple(out)


def with_diameters(tree: Tree, sections: Sequence[Sections]) -> Tree:
    """Return the tree with the measured diameters as its radii."""
    branches = [
        dataclasses.replace(
            branch, radius_mm=0.5 * np.interp(branch.arc_mm, own.arc_mm, own.diameter_mm)
        )
        for branch, own in zip(tree.branches, sections, strict=True)
    ]
    return dataclasses.replace(tree, branches=tuple(branches))


def sections_of_radii(tree: Tree) -> tuple[Sections, ...]:
    """Sections at the tree's own points and of its own radii, where no picture was asked."""
    out = []
    for branch in tree.branches:
        blank = np.zeros((0, len(branch)))
        out.append(
            Sections(
                arc_mm=branch.arc_mm,
                diameter_mm=2 * branch.radius_mm,
                sigma_mm=np.full(len(branch), np.nan),
                measured=np.ones(len(branch), bool),
                width_mm=blank,
                overlapped=blank.astype(bool),
            )
        )
    return tuple(out)


def _places(tree: Tree) -> _Places:
    parts = [_places_of(branch) for branch in tree.branches]
    sizes = [len(part[3]) for part in parts]
    points, tangents, radius, arc = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _Places(points, tangents, radius, np.repeat(np.arange(len(sizes)), sizes), arc)


def _places_of(branch: Branch) -> tuple[Points, Points, Scalars, Scalars]:
    length = branch.length_mm
    arc = np.linspace(0.0, length, max(2, round(length / STEP_MM) + 1))
    line, own = branch.points_mm, branch.arc_mm
    reach = along(line, own, arc + DIRECTION_MM) - along(line, own, arc - DIRECTION_MM)
    tangents = reach / np.maximum(np.linalg.norm(reach, axis=1, keepdims=True), 1e-12)
    radius = np.interp(arc, own, branch.radius_mm)
    return along(line, own, arc), tangents, radius, arc


def _seen(places: _Places, signal: Signal) -> _Seen:
    carm = signal.carm
    pixels, depth = carm.project(places.points_mm)
    per_mm = carm.px_per_mm(depth)
    ray = places.points_mm - carm.source_mm
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    cosine = np.abs(np.einsum("ij,ij->i", ray, places.tangents))
    sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
    shift = np.einsum("nij,nj->ni", carm.jacobian(places.points_mm), places.tangents)
    forward = shift / np.maximum(np.linalg.norm(shift, axis=1, keepdims=True), 1e-12)
    across = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    reach = REACH_RADII * places.radius_mm + REACH_MM
    x = np.linspace(-1.0, 1.0, SAMPLES) * reach[:, None]
    value, shown = signal.at(pixels[:, None] + (x * per_mm[:, None])[:, :, None] * across[:, None])
    course = Course(places.points_mm, places.radius_mm, places.branch, places.arc_mm, pixels,
                    forward, across, per_mm)  # fmt: skip
    pixel = 1.0 / float(np.median(per_mm))
    hidden = hidden_samples(course, x, pixel)
    core = np.abs(x) < places.radius_mm[:, None]
    overlapped = (hidden & core).sum(axis=1) > OVERLAP_SHARE * core.sum(axis=1)
    share = (x[:, 1] - x[:, 0]) * STEP_MM / pixel**2
    weight = (shown & ~hidden & (depth > 1.0)[:, None]) * np.minimum(share, 1e3)[:, None]
    profiles = Profiles(x, value, weight)
    clear = ~overlapped & (sine > CLEAR_SINE) & shown.all(axis=1) & ~hidden.any(axis=1)
    stretch = 1.0 / np.maximum(sine, 0.2)
    log_radius, sd, width = _fitted(profiles, stretch, places, signal, clear)
    # A slanting ray's path changes with the angle: d log(1 / sine) = cosine / sine d angle.
    sd = np.sqrt(sd**2 + (0.5 * TILT_SD * cosine / np.maximum(sine, 0.1)) ** 2 + MODEL_SD**2)
    sd = np.where(overlapped | (sine < 0.2), np.maximum(sd, 1.0), sd)
    # Errors that neighbours share are not averaged by joining them: they widen what is stated.
    shared = 1.0 if signal.kind != "contrast" else np.sqrt(CORRELATED_GREY / CORRELATED)
    outline = signal.kind == "mask"
    return _Seen(log_radius, sd, width, sine, overlapped, float(shared), outline)


def _fitted(
    profiles: Profiles, stretch: Scalars, places: _Places, signal: Signal, clear: Array
) -> tuple[Scalars, Scalars, Scalars]:
    """Log radius of the circle of equal area, its standard deviation, and the width, (n,)."""
    radius = places.radius_mm
    if signal.kind == "mask":
        return _mask_widths(profiles, signal.carm.pixel_at_isocenter_mm)
    judges = _judges(radius, clear)
    seen, belief = _believed(profiles, stretch, radius, judges, signal)
    blur, noise = _blur(seen[judges], stretch[judges], Belief(belief.mean[judges], belief.sd))
    sd, mean = belief.sd.copy(), belief.mean.copy()
    if not signal.calibrated:
        first = fit_profiles(seen, stretch, blur, belief, noise)
        mean[:, DEPTH] = _local_contrast(first, places, clear)
        sd[DEPTH] = np.hypot(OVAL_SD, CONTRAST_SD)
    fit = fit_profiles(seen, stretch, blur, Belief(mean, sd), noise)
    # What is deeper than wide is oval, or merely darker: shared by how likely either is.
    share = 0.5 if signal.calibrated else 0.5 * OVAL_SD**2 / sd[DEPTH] ** 2
    log_radius = fit.values[:, HALF] + share * (fit.values[:, DEPTH] - mean[:, DEPTH])
    C = fit.covariance
    variance = C[:, HALF, HALF] + 2 * share * C[:, HALF, DEPTH] + share**2 * C[:, DEPTH, DEPTH]
    misfit = _misfit(fit, seen, stretch, noise)
    spread = np.sqrt(np.maximum(CORRELATED * variance, 0.0) + misfit**2)
    return log_radius, spread, 2 * np.exp(fit.values[:, HALF])


def _misfit(fit: Fitted, seen: Profiles, stretch: Scalars, noise: float) -> Scalars:
    """(n,) what the model leaves beyond noise, as a share of the lumen's own signal.

    Where the axis runs beside the vessel, or another one lies there, it is no small one.
    """
    weight = seen.weight.sum(axis=1)
    left = (seen.weight * fit.residual**2).sum(axis=1) / np.maximum(weight, 1e-9)
    height = 2 * np.exp(fit.values[:, HALF] + fit.values[:, DEPTH]) * stretch
    out: Scalars = np.sqrt(np.maximum(left - (_NOISES * noise) ** 2, 0.0)) / np.maximum(
        height, 1e-9
    )
    return out


def _believed(
    profiles: Profiles, stretch: Scalars, radius: Scalars, judges: Array, signal: Signal
) -> tuple[Profiles, Belief]:
    """Profiles linear in the path, and what is believed of them before they are fitted.

    Of several display curves the one is right under which wide vessels of one contrast medium have
    one contrast per mm, whatever lies behind them.
    """
    found: list[tuple[float, int, Profiles, Belief]] = []
    for law in signal.laws:
        seen = Profiles(profiles.x_mm, law(profiles.signal), profiles.weight)
        belief = _belief(seen.signal, stretch, radius, judges, signal.calibrated)
        if len(signal.laws) == 1:
            return seen, belief
        own = Belief(belief.mean[judges], belief.sd)
        contrast = _level(belief, stretch, radius, judges)
        fit = fit_profiles(seen[judges], stretch[judges], USUAL_BLUR_MM, own, 0.03 * contrast)
        depth = fit.values[:, DEPTH]
        spread = float(np.median(np.abs(depth - np.median(depth))))
        left = float(np.median(np.abs(fit.residual[seen.weight[judges] > 0])))
        found.append((spread + left / contrast, len(found), seen, belief))
    return min(found)[2:]


def _level(belief: Belief, stretch: Scalars, radius: Scalars, judges: Array) -> float:
    """Signal in the middle of a usual vessel."""
    return float(np.median((2 * radius * stretch * np.exp(belief.mean[:, DEPTH]))[judges]))


def _belief(
    signal: Array, stretch: Scalars, radius: Scalars, judges: Array, calibrated: bool
) -> Belief:
    mean = np.zeros((len(radius), 5))
    mean[:, HALF] = np.log(radius)
    if calibrated:
        return Belief(mean, np.array([MIDDLE_SD, HALF_SD, OVAL_SD, GROUND_MM, GROUND_MM]))
    mean[:, GROUND] = np.median(signal[:, [0, 1, 2, -3, -2, -1]], axis=1)
    middle = SAMPLES // 2
    top = np.max(signal[:, middle - 1 : middle + 2], axis=1) - mean[:, GROUND]
    scale = float(np.median((top / (2 * radius * stretch))[judges]))
    mean[:, DEPTH] = np.log(max(scale, 1e-6))
    wide = float(np.ptp(signal)) + 1e-9
    return Belief(mean, np.array([MIDDLE_SD, HALF_SD, UNKNOWN_SD, wide, 0.5 * wide]))


def _judges(radius: Scalars, clear: Array) -> Array:
    """Sections that tell blur and contrast best: the wider half of the clear ones."""
    chosen = np.flatnonzero(clear)
    if not len(chosen):
        chosen = np.arange(len(radius))
    chosen = chosen[np.argsort(-radius[chosen], kind="stable")][: max(1, len(chosen) // 2)]
    return chosen[np.linspace(0, len(chosen) - 1, min(JUDGES, len(chosen))).astype(int)]


def _local_contrast(fit: Fitted, places: _Places, clear: Array) -> Scalars:
    """(n,) log of the signal per mm, smooth along each branch: display and scatter change it."""
    value, variance = fit.values[:, DEPTH], fit.covariance[:, DEPTH, DEPTH] + OVAL_SD**2
    whole = float(np.median(value[clear])) if clear.any() else float(np.median(value))
    weight = np.where(clear, 1.0, 0.1) / variance / (1 + ((value - whole) / 0.5) ** 2)
    out = np.empty(len(value))
    for k in range(int(places.branch[-1]) + 1):
        own = np.flatnonzero(places.branch == k)
        gap = (places.arc_mm[own, None] - places.arc_mm[own]) / CONTRAST_MM
        kernel = np.exp(-0.5 * gap**2) * weight[own]
        # The whole picture's scale counts as a few sections.
        few = 3.0 / OVAL_SD**2
        out[own] = (kernel @ value[own] + few * whole) / (kernel.sum(axis=1) + few)
    return out


def _mask_widths(profiles: Profiles, pixel_mm: float) -> tuple[Scalars, Scalars, Scalars]:
    """Half of the run of vessel round the axis: its log, standard deviation, and the width."""
    inside = np.maximum(profiles.signal, 0.0)
    middle = inside.shape[1] // 2
    left = np.cumprod(inside[:, middle::-1] > 0.02, axis=1)
    right = np.cumprod(inside[:, middle:] > 0.02, axis=1)
    run = np.concatenate([left[:, :0:-1], right], axis=1)
    step = profiles.x_mm[:, 1] - profiles.x_mm[:, 0]
    width = (inside * run).sum(axis=1) * step
    whole = (run[:, 0] == 0) & (run[:, -1] == 0) & ((profiles.weight > 0) | (run == 0)).all(axis=1)
    half = np.maximum(0.5 * width, 0.25 * pixel_mm)
    sd = np.where(whole & (width > 0), MASK_EDGE_PX * pixel_mm / half, 2.0)
    return np.log(half), np.minimum(sd, 2.0), 2 * half


def _blur(seen: Profiles, stretch: Scalars, belief: Belief) -> tuple[float, float]:
    """Blur that leaves the least, mm, and the noise that it leaves."""
    contrast = _level(belief, stretch, np.exp(belief.mean[:, HALF]), np.arange(len(stretch)))
    used, noise = seen.weight > 0, 0.03 * contrast
    residual = np.abs(fit_profiles(seen, stretch, USUAL_BLUR_MM, belief, noise).residual[used])
    noise = max(1.4826 * float(np.median(residual)), LEAST_NOISE * contrast)
    # All blurs in one batch: few profiles cost as much as many.
    n, trials = len(stretch), len(BLURS_MM)
    again = np.tile(np.arange(n), trials)
    fit = fit_profiles(
        seen[again], stretch[again], np.repeat(BLURS_MM, n),
        Belief(belief.mean[again], belief.sd), noise,
    )  # fmt: skip
    residuals = np.abs(fit.residual).reshape(trials, *used.shape)[:, used]
    costs = np.mean(np.minimum(residuals, 5 * noise), axis=1).tolist()
    k = int(np.argmin(costs))
    blur = BLURS_MM[k]
    if 0 < k < len(costs) - 1:
        parabola = np.polyfit(BLURS_MM[k - 1 : k + 2], costs[k - 1 : k + 2], 2)
        blur = float(np.clip(-0.5 * parabola[1] / parabola[0], BLURS_MM[k - 1], BLURS_MM[k + 1]))
    # The mean absolute deviation of normal noise is 0.8 of its standard deviation.
    return blur, max(1.2533 * costs[k], LEAST_NOISE * contrast)


def _joined(places: _Places, own: Array, seen: Sequence[_Seen]) -> Sections:
    """Join the views along one branch: robust data, and a walk with rare large steps."""
    arc = places.arc_mm[own]
    value = np.stack([view.log_radius[own] for view in seen])
    sd = np.stack([view.sd[own] for view in seen])
    if all(view.outline for view in seen):
        sine = np.stack([view.sine[own] for view in seen])
        sd = np.where(covered(arc, np.exp(value), sd, sine), np.maximum(sd, 1.0), sd)
    alone = np.count_nonzero(sd < UNKNOWN_SD_LOG, axis=0) < min(len(seen), 2)
    sd = np.hypot(sd, ALONE_SD * alone)
    start = np.log(places.radius_mm[own])
    stiff = 1.0 / (WALK**2 * np.maximum(np.diff(arc), 1e-3))
    x = np.clip((value / sd**2).sum(0) / (1 / sd**2).sum(0), start - 1.5, start + 1.5)
    n = len(arc)
    band = np.zeros((2, n))
    for _ in range(6):
        data = 1.0 / sd**2 / (1 + ((value - x) / (2 * sd)) ** 2)
        walk = stiff * (FREEDOM + 1) / (FREEDOM + stiff * np.diff(x) ** 2)
        anchor = np.full(n, STEP_MM / TUBE_SD**2)
        band[0] = data.sum(0) + anchor
        band[0, :-1] += walk
        band[0, 1:] += walk
        band[1, :-1] = -walk
        x = solveh_banded(band, (data * value).sum(0) + anchor * start, lower=True)
    spread = np.sqrt(_inverse_diagonal(band)) * max(view.shared for view in seen)
    diameter = 2 * np.exp(x)
    known = sd.min(axis=0) < UNKNOWN_SD_LOG
    return Sections(
        arc_mm=arc,
        diameter_mm=diameter,
        sigma_mm=diameter * spread,
        measured=known,
        width_mm=np.where(sd < 1.0, np.stack([view.width_mm[own] for view in seen]), np.nan),
        overlapped=np.stack([view.overlapped[own] for view in seen]),
    )


def _inverse_diagonal(band: Array) -> Scalars:
    """Diagonal of the inverse of a symmetric tridiagonal matrix, by its two sweeps."""
    # Plain numbers: one at a time, those of an array take several times as long.
    squares = (band[1, :-1] ** 2).tolist()
    down, up = band[0].tolist(), band[0].tolist()
    n = len(down)
    for k in range(1, n):
        down[k] -= squares[k - 1] / down[k - 1]
        up[n - 1 - k] -= squares[n - 1 - k] / up[n - k]
    out: Scalars = 1.0 / (np.array(down) + np.array(up) - band[0])
    return out
