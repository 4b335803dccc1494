"""Names of the main vessels, LM, LAD, LCx and RCA, each with a probability.

A *reading* of a component says which free end is the ostium and which ways are the named vessels:
``left`` (the common trunk of two ways is LM, their rest LAD and LCx) or ``right`` (one way, RCA).
Each reading is measured by a few figures of anatomy: directions in patient coordinates (the
anterior interventricular branch runs to the apex, forward, down and to the left; the circumflex
back round the left ventricle; the right coronary artery first to the right, then down and back),
lengths and calibres. Its score falls with the distance from what is usual,

    score = bias_side - 0.5 sum_i weight_i min(((figure_i - mean_i) / sd_i)^2, 16).

Readings that break a rule of anatomy (``RULES``) are left out. A softmax over the others and the
reading "none of these" (score 0) gives probabilities; a branch has the probability of all readings
that give it a name. Means, spreads and weights are in ``naming.json``, fitted by
``gcar_export.studies.naming_fit`` to generated trees, to mirrored and turned ones and parts of
them, which have no right reading, and to a dozen real ones named by the same rules of anatomy.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping
from importlib import resources

import numpy as np

from gcar_deploy.measure.routes import MOST_ROOTS, Route, end_radii, routes_from
from gcar_deploy.tree.tree import Tree
from gcar_deploy.types import Array, Scalars

#: a branch is named from this probability on
LEAST_CONFIDENCE = 0.8
#: figures further off than this many spreads count no more
_MOST_SPREADS = 4.0
#: ways shorter than this are no main vessel; trunks longer than this are no LM, mm
LEAST_WAY_MM, MOST_TRUNK_MM = 25.0, 45.0
#: branches beyond the end of the RCA (posterior descending, posterolateral) at most
_MOST_LAST = 2
#: directions near a bifurcation are taken over so much, mm
_NEAR_MM = 20.0
#: the two sides: names of the figures of a reading
_XYZ = ("left", "back", "up")
LEFT_FIGURES = (
    *(f"lad end {d}" for d in _XYZ), *(f"lcx end {d}" for d in _XYZ),
    *(f"lad begin {d}" for d in _XYZ), *(f"lcx begin {d}" for d in _XYZ),
    *(f"trunk {d}" for d in _XYZ),
    "trunk length", "lad of longest", "lcx of longest", "trunk calibre", "lad to lcx calibre",
    "ostium calibre", "lad straight", "lcx straight", "beyond lad", "beyond lcx", "share",
    "lad lower",
)  # fmt: skip
RIGHT_FIGURES = (
    *(f"part {k} {d}" for k in (1, 2, 3, 4) for d in _XYZ),
    "length", "straight", "ostium calibre", "calibre", "share", "largest side way",
)  # fmt: skip
#: rules without which there is no such reading, whatever the rest says: figure to (least, most).
#: The LAD ends at the apex, in front and at least 10 mm lower than the LCx, which sets out to the
#: back; the LM leaves the aorta to the left. The RCA sets out to the right, goes down, turns back
#: to the left along the diaphragm, and gives off nothing nearly as long as itself.
_LEFT_RULES = {
    "lad lower": (0.5, np.inf), "trunk left": (0.2, np.inf), "lad end up": (-np.inf, -0.2),
    "lad end back": (-np.inf, 0.1), "lcx begin back": (0.1, np.inf),
}  # fmt: skip
_RIGHT_RULES = {
    "part 1 left": (-np.inf, 0.2), "part 2 left": (-np.inf, 0.3), "part 2 up": (-np.inf, 0.0),
    "part 3 up": (-np.inf, 0.3), "part 4 left": (0.0, np.inf), "part 4 back": (0.0, np.inf),
    "largest side way": (-np.inf, 0.9),
}  # fmt: skip
RULES = {
    side: np.array([rules.get(name, (-np.inf, np.inf)) for name in figures]).T
    for side, figures, rules in (
        ("left", LEFT_FIGURES, _LEFT_RULES), ("right", RIGHT_FIGURES, _RIGHT_RULES),
    )
}  # fmt: skip
_LEAST_LOWER = _LEFT_RULES["lad lower"][0]
_PARTS = np.array([0.0, 0.15, 0.4, 0.7, 1.0])


@dataclasses.dataclass(frozen=True, kw_only=True)
class BranchName:
    """Name of a branch (LM, LAD, LCx, RCA) and the probability that it is right, 0 .. 1."""

    name: str
    confidence: float


@dataclasses.dataclass(frozen=True, eq=False)
class Reading:
    """One way to read a component: side, name of each named branch, figures, node of the ostium."""

    side: str
    names: dict[int, str]
    figures: Scalars
    inlet: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class Anatomy:
    """What anatomy says of a tree.

    Attributes
    ----------
    names : per branch its name, or None
    inlets : nodes at which a left main or right coronary artery begins, as sure as a name
    """

    names: tuple[BranchName | None, ...]
    inlets: tuple[int, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Template:
    """What is usual on one side: (k,) means, spreads and weights of the figures, and a bias."""

    mean: Scalars
    sd: Scalars
    weight: Scalars
    bias: float

    def scores(self, figures: Array) -> Scalars:
        """(n,) score of (n, k) figures."""
        z2 = np.minimum(((figures - self.mean) / self.sd) ** 2, _MOST_SPREADS**2)
        out: Scalars = self.bias - 0.5 * z2 @ self.weight
        return out


def read_anatomy(tree: Tree, usual: Mapping[str, Template] | None = None) -> Anatomy:
    """Name what can be named of a tree.

    Parameters
    ----------
    tree : Tree, mm LPS; its place does not matter, its directions do
    usual : what is usual on each side; None takes that of the package
    """
    names: list[BranchName | None] = [None] * len(tree.branches)
    if not tree.branches:
        return Anatomy(names=(), inlets=())
    inlets = []
    component = tree.components()
    of_branch = np.array([component[branch.start] for branch in tree.branches])
    for k in range(int(component.max()) + 1):
        found = readings(tree, np.flatnonzero(of_branch == k))
        shares = probabilities(found, usual or templates())
        for number, chances in _chances(found, shares).items():
            name = max(chances, key=lambda n: chances[n])
            if chances[name] >= LEAST_CONFIDENCE:
                names[number] = BranchName(name=name, confidence=chances[name])
        ostia: dict[int, float] = {}
        for reading, share in zip(found, shares, strict=True):
            ostia[reading.inlet] = ostia.get(reading.inlet, 0.0) + float(share)
        inlets += [node for node, share in ostia.items() if share >= LEAST_CONFIDENCE]
    if _contradicting(tree, names):
        return Anatomy(names=(None,) * len(names), inlets=())
    return Anatomy(names=tuple(names), inlets=tuple(inlets))


def readings(tree: Tree, own: Array) -> list[Reading]:
    """All readings of the component with the branches ``own``."""
    radii = end_radii(tree)
    mine = {n for k in own for n in (tree.branches[k].start, tree.branches[k].end)}
    ends = sorted((n for n in radii if n in mine), key=lambda n: (-radii[n], n))
    whole = sum(tree.branches[k].length_mm for k in own)
    out: list[Reading] = []
    for root in ends[:MOST_ROOTS]:
        ways = [w for w in routes_from(tree, root) if w.length_mm >= LEAST_WAY_MM]
        calibre = float(np.log(radii[root] / radii[ends[0]]))
        reach = _Reach.of(ways)
        # A lone line has no side branch to be told by.
        if len(own) > 2:
            found = (_right(way, ways, calibre, whole) for way in _beginnings(ways))
            out += [reading for reading in found if reading is not None]
        out += [
            reading
            for a in ways
            for c in ways
            if a is not c and (reading := _left(a, c, reach, calibre, whole)) is not None
        ]
    return [reading for reading in out if possible(reading.side, reading.figures)]


def possible(side: str, figures: Scalars) -> bool:
    """Whether a reading keeps the rules of its side, as far as its first figures tell."""
    low, high = RULES[side][:, : len(figures)]
    return bool(((figures >= low) & (figures <= high)).all())


def probabilities(found: list[Reading], usual: Mapping[str, Template]) -> Scalars:
    """(n,) probability of each reading; what is missing to 1 is that of none."""
    scores = np.zeros(len(found) + 1)
    for side, template in usual.items():
        which = [k for k, reading in enumerate(found) if reading.side == side]
        if which:
            scores[which] = template.scores(np.stack([found[k].figures for k in which]))
    scores -= scores.max()
    share = np.exp(scores)
    out: Scalars = share[:-1] / share.sum()
    return out


@functools.cache
def templates() -> dict[str, Template]:
    """Return what is usual, by side."""
    text = resources.files("gcar_deploy.measure").joinpath("naming.json").read_text("utf-8")
    out = {}
    for side, told in json.loads(text)["sides"].items():
        rows = np.array([[row["mean"], row["sd"], row["weight"]] for row in told["figures"]])
        out[side] = Template(rows[:, 0], rows[:, 1], rows[:, 2], float(told["bias"]))
    return out


def _chances(found: list[Reading], shares: Scalars) -> dict[int, dict[str, float]]:
    """Branch to the probability of each name that some reading gives it."""
    out: dict[int, dict[str, float]] = {}
    for reading, share in zip(found, shares, strict=True):
        for branch, name in reading.names.items():
            chances = out.setdefault(branch, {})
            chances[name] = chances.get(name, 0.0) + float(share)
    return out


def _beginnings(ways: list[Route]) -> list[Route]:
    """Ways, also without their last branches: the RCA ends where it gives off its last ones."""
    found: dict[tuple[int, ...], Route] = {}
    for way in ways:
        for count in range(max(len(way.branches) - _MOST_LAST, 1), len(way.branches) + 1):
            if way.node_arc_mm[count] >= LEAST_WAY_MM:
                found.setdefault(way.branches[:count], way.until(count))
    return [found[key] for key in sorted(found)]


@dataclasses.dataclass(frozen=True)
class _Reach:
    """How far any way from one ostium reaches: forward and down, back, and along itself, mm."""

    to_apex_mm: float
    to_back_mm: float
    longest_mm: float

    @staticmethod
    def of(ways: list[Route]) -> _Reach:
        if not ways:
            return _Reach(0.0, 0.0, 0.0)
        ends = np.array([way.points_mm[-1] for way in ways])
        to_apex = ends @ np.array([0.0, -0.7, -0.7])
        longest = max(way.length_mm for way in ways)
        return _Reach(float(to_apex.max()), float(ends[:, 1].max()), longest)


def _left(a: Route, c: Route, reach: _Reach, calibre: float, whole: float) -> Reading | None:
    """Read two ways as LAD and LCx; None without a common trunk, or against a rule."""
    lower = (c.points_mm[-1, 2] - a.points_mm[-1, 2]) / 20.0
    if lower < _LEAST_LOWER:
        # Most pairs end here: two ways are read either way round.
        return None
    shared = _shared(a, c)
    trunk = a.node_arc_mm[shared]
    lad, lcx = a.length_mm - trunk, c.length_mm - trunk
    if not shared or trunk > MOST_TRUNK_MM or min(lad, lcx) < LEAST_WAY_MM:
        return None
    fork, near_a = a.at(np.array([trunk, trunk + _NEAR_MM]))
    near_c = c.at(np.array(trunk + _NEAR_MM))
    to = np.array([a.points_mm[-1], c.points_mm[-1], near_a, near_c, a.points_mm[0]])
    steps = to - fork
    steps[-1] *= -1.0
    directions = _directions(steps)
    if not possible("left", directions):
        return None
    names = dict.fromkeys(a.branches[:shared], "LM")
    names |= dict.fromkeys(a.branches[shared:], "LAD")
    names |= dict.fromkeys(c.branches[shared:], "LCx")
    r_trunk = a.mean_radius(0.0, trunk)
    r_lad, r_lcx = (way.mean_radius(trunk, trunk + _NEAR_MM) for way in (a, c))
    longest = reach.longest_mm
    own_a = a.points_mm[-1] @ np.array([0.0, -0.7, -0.7])
    figures = [
        *directions,
        np.log(max(trunk, 1.0)), np.log(a.length_mm / longest), np.log(c.length_mm / longest),
        np.log(2 * r_trunk / (r_lad + r_lcx)), np.log(r_lad / r_lcx), calibre,
        np.linalg.norm(steps[0]) / lad, np.linalg.norm(steps[1]) / lcx,
        (reach.to_apex_mm - own_a) / 20.0, (reach.to_back_mm - c.points_mm[-1, 1]) / 20.0,
        (trunk + lad + lcx) / whole, lower,
    ]  # fmt: skip
    return Reading("left", names, np.array(figures), a.nodes[0])


def _shared(a: Route, b: Route) -> int:
    """Count the branches that two ways from one ostium begin with together."""
    shared = 0
    while shared < min(len(a.branches), len(b.branches)) and (
        a.branches[shared] == b.branches[shared]
    ):
        shared += 1
    return shared


def _right(way: Route, ways: list[Route], calibre: float, whole: float) -> Reading | None:
    """Read one way as RCA; None if it runs against a rule."""
    length = way.length_mm
    places = way.at(_PARTS * length)
    directions = _directions(places[1:] - places[:-1])
    if not possible("right", directions):
        # Most ways end here, and their directions cost least.
        return None
    off = [other.length_mm - other.node_arc_mm[_shared(way, other)] for other in ways]
    figures = [
        *directions,
        np.log(length), np.linalg.norm(places[-1] - places[0]) / length, calibre,
        np.log(way.mean_radius(0.5 * length, length) / way.mean_radius(0.0, 0.5 * length)),
        length / whole, max(off) / length,
    ]  # fmt: skip
    names = dict.fromkeys(way.branches, "RCA")
    return Reading("right", names, np.array(figures), way.nodes[0])


def _contradicting(tree: Tree, names: list[BranchName | None]) -> bool:
    """Whether a left tree would stand to the right of a right one."""
    middle = {}
    for side, of_side in (("left", ("LAD", "LCx")), ("right", ("RCA",))):
        points = [
            branch.points_mm[:, 0]
            for branch, name in zip(tree.branches, names, strict=True)
            if name is not None and name.name in of_side
        ]
        if points:
            middle[side] = float(np.concatenate(points).mean())
    return len(middle) == 2 and middle["left"] <= middle["right"]


def _directions(steps: Array) -> Scalars:
    """(3 k,) unit vectors of (k, 3) steps, one after the other."""
    length = np.sqrt(np.add.reduce(steps * steps, axis=1, keepdims=True))
    out: Scalars = (steps / np.maximum(length, 1e-9)).reshape(-1)
    return out
