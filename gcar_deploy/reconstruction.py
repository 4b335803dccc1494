"""Reconstruction: everything that was found, as arrays and as the content of result.json."""

from __future__ import annotations

import dataclasses
import functools
import json
import platform
import re
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any, Self

import numpy as np

from gcar_deploy.config import RunOptions
from gcar_deploy.flow import PressureDrop, doubts_of, pressure_drop, pressure_table
from gcar_deploy.gaussians.gaussians import Gaussians
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.observability import (
    EXACT_DISAGREEMENT,
    depth_and_plane,
    silent_errors,
)
from gcar_deploy.geometry.own_frame import OwnFrame
from gcar_deploy.geometry.scene import told_view
from gcar_deploy.imaging.angiogram import Angiogram, VesselImage
from gcar_deploy.imaging.own_frame import found_as_given, turns_back
from gcar_deploy.measure import BranchName, Measured, Sections, lumen_tree, measured
from gcar_deploy.measure.lumen import BranchLumen, tree_lumens
from gcar_deploy.measure.naming import LEAST_CONFIDENCE
from gcar_deploy.plain import plain
from gcar_deploy.pose import Pose
from gcar_deploy.quality import Quality, part_lengths_mm, unexplained
from gcar_deploy.tree.tree import Branch, Tree, along
from gcar_deploy.tubes import CloseCall, Ending
from gcar_deploy.types import Mask, Scalars, Volume

SCHEMA = "gcar-result/1"
RESEARCH_USE = "Research use only. Not a medical device; not for diagnosis or treatment."
_PACKAGES = (
    "gcar", "numpy", "scipy", "opencv-contrib-python-headless", "scikit-image", "onnxruntime",
)  # fmt: skip
#: keys of a branch: stated wherever it is long enough, and of a lesion alone
_LUMEN = (
    "minimal_diameter_mm", "minimal_at_mm", "reference_diameter_mm", "stenosis_percent",
    "lesion_length_mm", "minimal_sigma_mm", "area_stenosis_percent", "plaque_free_mm",
)  # fmt: skip
_LESION = ("lesion_mm", "proximal_reference_mm", "distal_reference_mm")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction:
    """What one reconstruction found; what follows from it is worked out once, when first asked.

    Attributes
    ----------
    quality : Quality
    tree : Tree, mm LPS; branches run from their inlets (``measure.inlet``)
    sections : of each branch, the diameters that the pictures show; None: the radii of the tree
    gaussians : Gaussians
    volume : (nx, ny, nz) float32 vessel occupancy 0 .. 1 on ``grid``
    grid : Grid
    angiograms : the pictures as they were given, but with the motion of the heart undone where any
        was found
    views : what was found in them, with the geometry that was used (poses applied)
    poses : correction of each view; one of them, by the scene's own order, stays as it was told
    seconds : wall-clock seconds per stage, and ``total``
    counts : whole numbers worth knowing (candidates, Gaussians, steps ...)
    losses : as ``Refined`` has them: the objective at each start and after each accepted step
    predictor, refiner : what was used
    model : name and SHA-256 of the centre predictor, None without one
    segmenter : the same of the network that found vessels, None where none did
    notes : sentences for the user that do not lower the status
    options : RunOptions
    ending : how the fit of the tubes ended, None where none were fitted
    close_calls : pieces of vessel that were kept or dropped by a hair
    """

    quality: Quality
    tree: Tree
    sections: tuple[Sections, ...] | None
    gaussians: Gaussians
    volume: Volume
    grid: Grid
    angiograms: tuple[Angiogram, ...]
    views: tuple[VesselImage, ...]
    poses: tuple[Pose, ...]
    seconds: Mapping[str, float]
    counts: Mapping[str, int]
    losses: tuple[float, ...]
    predictor: str
    refiner: str
    model: Mapping[str, str] | None
    segmenter: Mapping[str, str] | None
    notes: tuple[str, ...]
    options: RunOptions
    ending: Ending | None = None
    close_calls: tuple[CloseCall, ...] = ()

    @property
    def status(self) -> str:
        """``ok`` or ``degraded``."""
        return self.quality.status

    @property
    def _carms(self) -> list[CArm]:
        return [view.carm for view in self.views]

    @property
    def _exact(self) -> bool:
        """Calibrated pictures whose vessel mass leaves no room for an angle error."""
        after = self.quality.disagreement
        calibrated = all(view.calibrated for view in self.views)
        return calibrated and after is not None and after <= EXACT_DISAGREEMENT

    @functools.cached_property
    def measured(self) -> Measured:
        """Lumen, names, angles, foreshortening and the view to take next."""
        return measured(self.tree, self.views, self.sections, self.options.lesions)

    @functools.cached_property
    def lumen(self) -> tuple[Tree, tuple[Sections, ...]]:
        """The tree with a point at each section, as ``diameters.csv`` has it; its sections."""
        return lumen_tree(self.tree, self.sections)

    @functools.cached_property
    def pressure(self) -> PressureDrop:
        """Pd/Pa along each branch at the usual assumed flow."""
        found = () if self.quality.ghosts is None else self.quality.ghosts.probable
        ghosts = {ghost.branch: ghost.probability for ghost in found}
        doubts = doubts_of(self.status, len(self.tree.branches), ghosts)
        names = [None if name is None else name.name for name in self.names]
        tree, sections = self.lumen
        return pressure_drop(tree, tree_lumens(tree, sections), doubts=doubts, names=names)

    @functools.cached_property
    def unexplained(self) -> tuple[Mask, ...]:
        """Per view (rows, cols) the pixels of its skeleton that no branch explains."""
        return tuple(unexplained(self.tree, view, self.options.quality) for view in self.views)

    @property
    def ghost_probability(self) -> tuple[Scalars, ...]:
        """Per branch (m,) probability of lying more than 2 mm from any vessel; NaN: not known."""
        ghosts = self.quality.ghosts
        if ghosts is None:
            return tuple(np.full(len(branch), np.nan) for branch in self.tree.branches)
        return ghosts.points

    @property
    def names(self) -> tuple[BranchName | None, ...]:
        """Name of each branch (LM, LAD, LCx, RCA) with its probability; None: a number only."""
        return self.measured.names

    def as_given(
        self, frame: OwnFrame, angiograms: Sequence[Angiogram], grid: Grid, options: RunOptions
    ) -> Self:
        """Return what was found in the scene's own frame as the scene was given.

        Parameters
        ----------
        frame : OwnFrame
        angiograms, grid, options : in the coordinates and the order that they were given in
        """
        places = [frame.place(k) for k in range(len(angiograms))]
        poses = tuple(
            dataclasses.replace(
                self.poses[p].seen_turned(turns_back(frame, k)),
                partner=frame.order[self.poses[p].partner],
            )
            for k, p in enumerate(places)
        )
        views = tuple(
            dataclasses.replace(found, carm=pose.applied(found.carm))
            for found, pose in zip(found_as_given(frame, self.views), poses, strict=True)
        )
        stills = tuple(pose.still(a) for pose, a in zip(poses, angiograms, strict=True))
        judged = tuple(self.quality.views[p] for p in places)
        gates, count = options.quality, len(poses)
        said = (p.note(a.view_id, count, gates) for p, a in zip(poses, angiograms, strict=True))
        means = self.gaussians.means_mm + frame.origin_mm
        given = dataclasses.replace(
            self,
            quality=dataclasses.replace(self.quality, views=judged),
            tree=self.tree.moved(frame.origin_mm),
            gaussians=dataclasses.replace(self.gaussians, means_mm=means),
            grid=grid, angiograms=stills, views=views, poses=poses, options=options,
            notes=(*self.notes, *filter(None, said)),
            close_calls=tuple(
                dataclasses.replace(call, middle_mm=call.middle_mm + frame.origin_mm)
                for call in self.close_calls
            ),
        )  # fmt: skip
        if not options.lesions:
            return given
        return dataclasses.replace(given, notes=(*given.notes, *given.measured.on_marks))

    def summary(self) -> dict[str, Any]:
        """Content of ``result.json`` without the list of files; plain, finite values only."""
        copied: dict[str, Any] = json.loads(json.dumps(self._summary))
        return copied

    def to_json(self) -> str:
        """``summary`` as strict JSON text."""
        return json.dumps(self._summary, indent=1, allow_nan=False) + "\n"

    @functools.cached_property
    def _summary(self) -> dict[str, Any]:
        reasons: dict[str, str] = {}
        further, pressure = self.measured.further, pressure_table(self.pressure)
        body: dict[str, Any] = {
            "schema": SCHEMA,
            "status": self.quality.status,
            "sentence": self.quality.sentence,
            "findings": list(self.quality.findings),
            "notes": list(self.notes),
            "separation_deg": self.quality.separation_deg,
            "epipolar_disagreement": self.quality.disagreement,
            "views": [self._view(k) for k in range(len(self.views))],
            # Of the geometry as told: a pose that was found for it hides a scale that is wrong.
            "silent_errors": list(
                silent_errors([a.carm for a in self.angiograms], exact=self._exact)
            ),
            "tree": {
                "length_mm": self.tree.length_mm,
                "parts_mm": list(part_lengths_mm(self.tree)),
                "branches": self._branches(),
                "bifurcations": self._bifurcations(),
            },
            "ambiguity": self._ambiguity(),
            "pressure": pressure,
            "volume": {
                "center_mm": list(self.grid.center_mm),
                "size_mm": list(self.grid.size_mm),
                "shape": list(self.grid.shape),
            },
            "best_further_view": None if further is None else dataclasses.asdict(further),
            "counts": dict(self.counts),
            "losses": list(self.losses),
            "fit": None if self.ending is None else dataclasses.asdict(self.ending),
            "seconds": dict(self.seconds),
            "predictor": self.predictor,
            "refiner": self.refiner,
            "model": None if self.model is None else dict(self.model),
            "segmenter": None if self.segmenter is None else dict(self.segmenter),
            "options": dataclasses.asdict(self.options),
            "versions": versions(),
            "use": RESEARCH_USE,
        }
        out: dict[str, Any] = plain(body, "", reasons)
        for path in reasons:
            if path.startswith("/tree/branches/") and path.split("/")[-1] in (*_LUMEN, "lesions"):
                reasons[path] = "the branch is too short to state a stenosis"
            if "/picture/frame/" in path:
                reasons[path] = (
                    "chosen without a look at another run, or no frame shows another phase"
                )
            if path.endswith(("/name", "/name_confidence")):
                reasons[path] = f"no name is as probable as {LEAST_CONFIDENCE:g}"
            if path.endswith(("/ghost_probability", "/ghost_share")):
                reasons[path] = "known of two views with the predictor that sees both alone"
            if path.startswith("/pressure/branches/"):
                k = int(path.split("/")[3])
                reasons[path] = pressure["branches"][k]["withheld"]
        if self.model is None:
            reasons["/model"] = "made without a model"
        if self.ending is None:
            reasons["/fit"] = "no tubes were fitted"
        if self.segmenter is None:
            reasons["/segmenter"] = "no network found vessels in the pictures"
        out["reasons"] = reasons
        return out

    def _branches(self) -> list[dict[str, Any]]:
        ghosts = self.quality.ghosts
        told = [None] * len(self.tree.branches) if ghosts is None else ghosts.branches.tolist()
        parts = zip(self.tree.branches, self.measured.lumens, self.names, told, strict=True)
        return [
            {"branch": k, **_branch(branch, lumen, name, self._carms), "ghost_probability": ghost}
            for k, (branch, lumen, name, ghost) in enumerate(parts, start=1)
        ]

    def _ambiguity(self) -> dict[str, Any]:
        """Say how much of the tree other trees would explain nearly as well, and where."""
        ghosts = self.quality.ghosts
        return {
            "ghost_share": None if ghosts is None else ghosts.share,
            "probable_ghosts": [
                {
                    "branch": ghost.branch + 1,
                    "start_mm": ghost.start_mm,
                    "end_mm": ghost.end_mm,
                    "middle_mm": self._place(ghost.branch, 0.5 * (ghost.start_mm + ghost.end_mm)),
                    "probability": ghost.probability,
                }
                for ghost in (() if ghosts is None else ghosts.probable)
            ],
            "exchangeable": [
                {
                    "branches": [k + 1 for k in pair.branches],
                    "stretches_mm": [list(stretch) for stretch in pair.stretches_mm],
                    "middles_mm": [
                        self._place(k, 0.5 * sum(stretch))
                        for k, stretch in zip(pair.branches, pair.stretches_mm, strict=True)
                    ],
                    "difference": pair.difference,
                }
                for pair in self.quality.exchanges
            ],
            "close_calls": [dataclasses.asdict(call) for call in self.close_calls],
        }

    def _place(self, branch: int, at_mm: float) -> list[float]:
        """Point of a branch so far from its inlet, mm LPS."""
        own = self.tree.branches[branch]
        place: list[float] = along(own.points_mm, own.arc_mm, np.array(at_mm)).tolist()
        return place

    def _bifurcations(self) -> list[dict[str, Any]]:
        """Nodes where three or more branches meet, with the angle between each two of them."""
        found: dict[int, dict[str, Any]] = {}
        for angle in self.measured.angles:
            place = self.tree.nodes_mm[angle.node].tolist()
            node = found.setdefault(
                angle.node, {"node": angle.node, "position_mm": place, "angles": []}
            )
            pair = [angle.first + 1, angle.second + 1]
            node["angles"].append({"branches": pair, "angle_deg": angle.angle_deg})
        for bifurcation in self.measured.bifurcations:
            node = found[bifurcation.node]
            node["calibre_ratio"] = bifurcation.calibre_ratio
            node["segments"] = [
                {**dataclasses.asdict(segment), "branch": segment.branch + 1}
                for segment in bifurcation.segments
            ]
        return list(found.values())

    def _view(self, k: int) -> dict[str, Any]:
        angiogram, judged, pose = self.angiograms[k], self.quality.views[k], self.poses[k]
        return {
            "id": angiogram.view_id,
            "name": judged.name,
            "picture": {
                "sha256": angiogram.sha256,
                "bit_depth": angiogram.bit_depth,
                "rows": angiogram.carm.rows,
                "columns": angiogram.carm.columns,
                **({"mask_sha256": angiogram.mask_sha256} if angiogram.mask_sha256 else {}),
                **({} if angiogram.frame is None else {"frame": angiogram.frame.to_dict()}),
            },
            "geometry": told_view(angiogram.carm, angiogram.intensity),
            "kind": self.views[k].kind,
            "calibrated": self.views[k].calibrated,
            "coverage": judged.coverage,
            "support": judged.support,
            "distance_mm": judged.distance_mm,
            "overlap": judged.overlap,
            "coverage_2px": judged.coverage_2px,
            "coverage_even": judged.coverage_even,
            "left_out": judged.left_out,
            "match_rate": judged.match_rate,
            "foreshortening": judged.foreshortening,
            "disagreement_before": pose.before,
            "disagreement_after": pose.after,
            "landmark_gap_before_mm": pose.landmark_before_mm,
            "landmark_gap_after_mm": pose.landmark_after_mm,
            "estimated_offset_mm": list(pose.offset_mm),
            "estimated_primary_deg": pose.primary_deg,
            "estimated_secondary_deg": pose.secondary_deg,
            "pose_converged": pose.converged,
            "motion_mm": pose.motion_mm,
        }


def versions() -> dict[str, str | None]:
    """Versions of everything that computes; None for what is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            about = metadata.distribution(name).read_text("METADATA") or ""
        except metadata.PackageNotFoundError:
            about = ""
        # ``metadata.version`` parses pages of licences for this one line.
        line = re.search(r"^Version: *(\S+)", about, re.MULTILINE)
        found[name] = line and line[1]
    return found


def _branch(
    branch: Branch, lumen: BranchLumen, name: BranchName | None, carms: Sequence[CArm]
) -> dict[str, Any]:
    known = branch.sigma_mm[np.isfinite(branch.sigma_mm)]
    return {
        "name": None if name is None else name.name,
        "name_confidence": None if name is None else name.confidence,
        "start": branch.start,
        "end": branch.end,
        "length_mm": branch.length_mm,
        "mean_radius_mm": float(branch.radius_mm.mean()),
        "min_radius_mm": float(branch.radius_mm.min()),
        "mean_sigma_mm": float(known.mean()) if len(known) else None,
        **_sigma(branch, carms),
        "confidence": float(branch.confidence.mean()),
        **{key: getattr(lumen, key) for key in (*_LUMEN, *_LESION)},
        "lesions": lumen.lesions and [dataclasses.asdict(one) for one in lumen.lesions],
        **({} if lumen.narrows_to_mm is None else {"narrows_to_mm": lumen.narrows_to_mm}),
    }


def _sigma(branch: Branch, carms: Sequence[CArm]) -> dict[str, float | None]:
    """Mean sigma of a branch by its causes and by its axes; None where it is unknown."""
    names = (
        "mean_sigma_fit_mm", "mean_sigma_geometry_mm", "mean_sigma_depth_mm", "mean_sigma_plane_mm",
    )  # fmt: skip
    if branch.covariance_mm2 is None:
        return dict.fromkeys(names)
    axes = depth_and_plane(branch.covariance_mm2.sum(axis=1), branch.points_mm, carms)
    means = (float(sigma.mean()) for sigma in (*branch.sigma_parts_mm.T, *axes))
    return dict(zip(names, means, strict=True))
