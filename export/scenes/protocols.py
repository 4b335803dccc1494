"""The simulated set-ups: a label becomes a ``Case``.

========== ==================================================================================
protocol   what
========== ==================================================================================
paper      whole tree, n views 180/n deg apart at secondary 0, 128x128 path lengths, cube of
           128^3 voxels of h = 1.40625 mm (180 mm), SOD 1000 h, SDD 1500 h, pitch 1.5 h
clinical   left tree alone, RAO30 CAU20 and LAO45 CRA25, SOD 765, SDD 1100 and 1060, 512x512
           path lengths at 0.39 mm, 128^3 voxels of 1 mm
moved      as clinical, but the patient moved by (1.5, -2, 3) mm before view 2 and its primary
           angle is 1 deg off; the scene says nothing of it
raw        as clinical, but 8-bit raw pictures with noise, spine, ribs and diaphragm
common-lca left artery alone, its centroid in the isocentre, binary masks of 256x256 pixels of
           0.65 mm, RAO25 CAU35 and LAO40 CRA20, SOD 750, SDD 900, voxels of 0.5 mm (PPCAR-Net,
           arXiv 2610.09383; ``common`` is this and the next)
common-rca right artery alone, the same with 0.55 mm, RAO20 CRA20 and LAO60
thin-...   generated left trees with thin branches on 960 pixels of 0.184 mm, noise of 0, 0.05 or
           0.2 mm (``thin_protocol``; ``thin`` is all three)
========== ==================================================================================
"""

from __future__ import annotations

import dataclasses
import hashlib
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gcar_deploy.errors import UsageError
from gcar_deploy.geometry.carm import CArm
from gcar_deploy.geometry.grid import Grid
from gcar_deploy.geometry.scene import Intensity, Scene, View, scene_to_json
from gcar_deploy.imaging.angiogram import Angiogram
from gcar_deploy.types import Array, Points, Volume
from gcar_export.scenes.labels import LabelVolume
from gcar_export.scenes.raw_pictures import raw_picture
from gcar_export.scenes.raycast import raycast, silhouette

#: set-ups with masks of one artery -> side of the label, pitch in mm, (primary, secondary)
COMMON: Mapping[str, tuple[int, float, tuple[tuple[float, float], ...]]] = {
    "common-lca": (0, 0.65, ((-25, -35), (40, 20))),
    "common-rca": (1, 0.55, ((-20, 20), (60, 0))),
}
#: where masks are made of rendered paths: a ray through so much vessel or more is vessel, mm
MASK_PATH_MM = 0.25
PROTOCOLS = ("paper", "clinical", "moved", "raw", *COMMON)
#: mm of vessel per count of a simulated 16-bit picture.
MM_PER_COUNT = 0.001
PAPER_VOXEL_MM = 180.0 / 128
#: (primary, secondary, SDD) of the clinical set-up; 2 views are the first two, and so on.
CLINICAL_VIEWS = (
    (-30, -20, 1100), (45, 25, 1060), (-30, 25, 1100), (45, -25, 1060),
    (0, 35, 1100), (0, -30, 1060), (90, 0, 1100), (-10, 35, 1060),
    (-45, 0, 1100), (30, 0, 1060), (60, 15, 1100), (-20, -30, 1060),
    (20, 30, 1100), (60, -20, 1060), (-60, 20, 1100), (20, -25, 1060),
)  # fmt: skip
#: half-way between the two clinical views, and a quarter turn from there.
CLINICAL_NEW_VIEWS = ((7.5, 2.5, 1100), (-82.5, 2.5, 1100))
MOVED_SHIFT_MM = (1.5, -2.0, 3.0)
MOVED_PRIMARY_DEG = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One simulated examination with its truth.

    Attributes
    ----------
    name, protocol : str
    scene : Scene
        What the reconstruction is told; for ``moved`` that is not the whole truth.
    pictures : tuple of (rows, columns) uint16 or uint8
        One per view, in the scene's order.
    label : LabelVolume
        The tree in the scene's frame.
    truth : (nx, ny, nz) float32
        Area-averaged occupancy on ``scene.volume_grid()``.
    new_views : tuple of CArm
        Directions not used for fitting.
    line_mm : (n, 3) or None
        Points of the true centreline, where it is known exactly, mm LPS.
    """

    name: str
    protocol: str
    scene: Scene
    pictures: tuple[Array, ...]
    label: LabelVolume
    truth: Volume
    new_views: tuple[CArm, ...]
    line_mm: Points | None = None

    @property
    def grid(self) -> Grid:
        """The voxels that the result is asked on."""
        return self.scene.volume_grid()

    @property
    def scene_carms(self) -> list[CArm]:
        """The views as the scene tells them."""
        return [view.carm for view in self.scene.views]

    def angiograms(self) -> list[Angiogram]:
        """Return the pictures as the runtime's input."""
        return [
            Angiogram(
                view_id=view.id,
                carm=view.carm,
                pixels=picture.astype(np.float32),
                bit_depth=8 * picture.dtype.itemsize,
                intensity=view.intensity,
                sha256=hashlib.sha256(picture.tobytes()).hexdigest(),
            )
            for view, picture in zip(self.scene.views, self.pictures, strict=True)
        ]

    def new_projections(self) -> list[Array]:
        """Return the truth seen from ``new_views``, path lengths in mm."""
        return [raycast(self.label, carm) for carm in self.new_views]


def make_case(label: LabelVolume, protocol: str, views: int = 2) -> Case:
    """Simulate one case.

    Parameters
    ----------
    label : LabelVolume
        The whole label volume; the clinical protocols take the left tree out of it, the common
        ones the left or the right.
    protocol : str
        One of ``PROTOCOLS``.
    views : int
        Number of views, 2 .. 16.

    Raises
    ------
    UsageError
        On an unknown protocol, a number of views out of range, or a label without two
        separate trees where the left one is needed.
    """
    if protocol not in PROTOCOLS:
        raise UsageError(f"protocol {protocol!r} is none of {', '.join(PROTOCOLS)}")
    if not 2 <= views <= len(CLINICAL_VIEWS):
        raise UsageError(f"views = {views} is outside 2 .. {len(CLINICAL_VIEWS)}")
    if protocol in COMMON and views != len(COMMON[protocol][2]):
        raise UsageError(f"views = {views}: protocol {protocol} has two views")
    if protocol == "paper":
        tree, carms, new, grid = label.roughly_centred(), *_paper_geometry(views)
    elif protocol in COMMON:
        tree = at_centroid(label.left_right()[COMMON[protocol][0]])
        carms, new, grid = common_geometry(protocol)
    else:
        tree = label.left_right()[0].centred()
        carms, new, grid = clinical_geometry(views)
    pictures, intensity = _pictures(tree, protocol, carms)
    scene = Scene(
        views=tuple(
            View(id=str(index + 1), carm=carm, intensity=intensity)
            for index, carm in enumerate(carms)
        ),
        grid=grid,
    )
    return Case(
        name=label.name,
        protocol=protocol,
        scene=scene,
        pictures=pictures,
        label=tree,
        truth=tree.on_grid(grid),
        new_views=tuple(new),
    )


def write_case(case: Case, folder: Path) -> list[Path]:
    """Write ``view1.png`` ..., ``geom.json`` and ``truth.nii.gz``; return their paths."""
    import cv2
    import nibabel

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for index, picture in enumerate(case.pictures):
        path = folder / f"view{index + 1}.png"
        done, blob = cv2.imencode(".png", picture)
        if not done:
            raise UsageError(f"cannot encode {path}")
        path.write_bytes(blob.tobytes())
        paths.append(path)
    geometry, truth = folder / "geom.json", folder / "truth.nii.gz"
    geometry.write_text(scene_to_json(case.scene))
    nibabel.save(nibabel.Nifti1Image(case.truth, case.grid.affine_ras()), truth)
    return [*paths, geometry, truth]


def case_geometry(protocol: str, views: int) -> tuple[list[CArm], Grid]:
    """Return views and grid of a set-up, ``paper`` or one of the clinical ones."""
    carms, _, grid = (_paper_geometry if protocol == "paper" else clinical_geometry)(views)
    return carms, grid


def _paper_geometry(views: int) -> tuple[list[CArm], list[CArm], Grid]:
    h = PAPER_VOXEL_MM
    grid = Grid(center_mm=(0, 0, 0), size_mm=(128 * h,) * 3, shape=(128, 128, 128))

    def carm(primary: float) -> CArm:
        return CArm(
            primary_angle_deg=primary,
            secondary_angle_deg=0,
            sod_mm=1000 * h,
            sdd_mm=1500 * h,
            rows=128,
            columns=128,
            pixel_spacing_mm=(1.5 * h, 1.5 * h),
        )

    step = 180.0 / views
    return (
        [carm(k * step) for k in range(views)],
        [carm((k + 0.5) * step) for k in range(views)],
        grid,
    )


def clinical_geometry(views: int) -> tuple[list[CArm], list[CArm], Grid]:
    """Return views, new views and grid of the clinical set-up."""
    grid = Grid(center_mm=(0, 0, 0), size_mm=(128, 128, 128), shape=(128, 128, 128))

    def carm(primary: float, secondary: float, sdd: float) -> CArm:
        return CArm(
            primary_angle_deg=primary,
            secondary_angle_deg=secondary,
            sod_mm=765,
            sdd_mm=sdd,
            rows=512,
            columns=512,
            pixel_spacing_mm=(0.39, 0.39),
        )

    return (
        [carm(*view) for view in CLINICAL_VIEWS[:views]],
        [carm(*view) for view in CLINICAL_NEW_VIEWS],
        grid,
    )


def common_geometry(protocol: str) -> tuple[list[CArm], list[CArm], Grid]:
    """Return views, no new views, and the grid that measures are taken on."""
    _, pitch, directions = COMMON[protocol]
    carms = [
        CArm(
            primary_angle_deg=primary,
            secondary_angle_deg=secondary,
            sod_mm=750,
            sdd_mm=900,
            rows=256,
            columns=256,
            pixel_spacing_mm=(pitch, pitch),
        )
        for primary, secondary in directions
    ]
    return carms, [], Grid(center_mm=(0, 0, 0), size_mm=(128,) * 3, shape=(256,) * 3)


def at_centroid(tree: LabelVolume) -> LabelVolume:
    """Return the tree moved so that its centroid is the isocentre."""
    filled = np.argwhere(tree.occupancy >= 0.5)
    return tree.moved(-tree.grid.index2world(filled.mean(axis=0)))


def _pictures(
    tree: LabelVolume, protocol: str, carms: Sequence[CArm]
) -> tuple[tuple[Array, ...], Intensity]:
    """Draw what the views show; say what a pixel means."""
    if protocol in COMMON:
        masks = tuple(np.uint8(255) * silhouette(tree, carm) for carm in carms)
        return masks, Intensity(kind="mask", polarity="bright", mm_per_count=None)
    truly = _as_it_was if protocol == "moved" else _as_given
    paths = [truly(tree, carm, index) for index, carm in enumerate(carms)]
    if protocol == "raw":
        rng = np.random.default_rng(zlib.crc32(tree.name.encode()))
        raw = tuple(raw_picture(path, rng) for path in paths)
        return raw, Intensity(kind="raw", polarity="dark", mm_per_count=None)
    counts = tuple(_counts(path) for path in paths)
    return counts, Intensity(kind="path_length", polarity="bright", mm_per_count=MM_PER_COUNT)


def _as_given(tree: LabelVolume, carm: CArm, index: int) -> Array:
    return raycast(tree, carm)


def _as_it_was(tree: LabelVolume, carm: CArm, index: int) -> Array:
    """Picture of a patient and gantry that are off in every view but the first, to and fro."""
    if index == 0:
        return raycast(tree, carm)
    sign = 1.0 if index % 2 else -1.0
    shift = sign * np.array(MOVED_SHIFT_MM)
    turned = carm.turned(sign * MOVED_PRIMARY_DEG)
    return raycast(tree.moved(shift), turned, margin_mm=float(np.linalg.norm(shift)))


def _counts(path_mm: Array) -> Array:
    return np.clip(np.rint(path_mm / MM_PER_COUNT), 0, 65535).astype(np.uint16)
